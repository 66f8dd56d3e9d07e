"""Episodes: environments stepped under a policy until every episode has ended, and recorded."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.environments import Environments, Step
from jbrep.envs.infos import Numbers
from jbrep.envs.task import Array

_Seen = TypeVar("_Seen", bound=NDArray[Any])
Actor = Callable[[Array], NDArray[Any]]  # observations (n, d) to actions (n, k), once for each step
Tick = Callable[[int], object]  # called with the number of steps just made, over all environments
# of the environments as they are, (n, ...) each
Read = Callable[[Environments], Mapping[str, Array]]


class PlayedStep(NamedTuple):
    """A step of n environments, and what came before it."""

    observation: Array  # before it, (n, d)
    action: NDArray[Any]  # (n, k)
    active: NDArray[np.bool_]  # the environments whose episode went on, (n,)
    step: Step


def play(envs: Environments, act: Actor) -> Iterator[PlayedStep]:
    """Step until every episode has ended; while a step is yielded, they are where it led."""
    while envs.num_active:
        observation, active = envs.observation, envs.active
        action = act(observation)
        yield PlayedStep(observation, action, active, envs.step(action))


def held(
    act: Callable[[_Seen], NDArray[Any]], repeat: int, chunk: int = 1
) -> Callable[[_Seen], NDArray[Any]]:
    """The actor that lets another choose actions, and holds each for so many steps.

    It chooses `chunk` of them at once, (..., chunk * k), which are played one after the other.
    Environments must be at the start of their episodes when it first acts.
    """
    upcoming: list[NDArray[Any]] = []

    def choose_or_hold(observation: _Seen) -> NDArray[Any]:
        nonlocal upcoming
        if not upcoming:
            chosen = np.split(act(observation), chunk, axis=-1)
            upcoming = [each for each in chosen for _ in range(repeat)]
        return upcoming.pop(0)

    return choose_or_hold


def open_loop(actions: Iterable[NDArray[Any]]) -> Actor:
    """The actor that plays given actions (n, k), one after the other."""
    remaining = iter(actions)
    return lambda observation: next(remaining)


def read_nothing(envs: Environments) -> Mapping[str, Array]:
    """Record observations and rewards alone."""
    return {}


def read_states(envs: Environments) -> Mapping[str, Array]:
    """Record what moves of the task's arrays, too."""
    return {name: envs.arrays[name] for name in envs.task.state}


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """What n environments went through in T steps; the first axis is time.

    An environment whose episode ended early stands still: its rows from `length` on mean nothing.
    """

    start: Mapping[str, Array]  # the task's arrays before the first step, (n, width) each
    observation: NDArray[np.float32]  # before, between and after the steps, (T + 1, n, d)
    arrays: Mapping[str, Array]  # what was read at the same times, (T + 1, n, ...) each
    action: NDArray[Any]  # (T, n, k)
    reward: NDArray[np.float32]  # (T, n)
    terminated: NDArray[np.bool_]  # whether a state ended the episode, (n,)
    truncated: NDArray[np.bool_]  # whether the time limit did, or physics that diverged, (n,)
    length: NDArray[np.int32]  # of each episode, (n,)
    missing: NDArray[np.int64]  # readings for which the one before stands, or the end, (n,)


def record(envs: Environments, act: Actor, tick: Tick, read: Read = read_nothing) -> Recording:
    """Play the episodes that the environments are at the start of, and record them."""
    start, reads = _copied(envs.arrays), [_copied(read(envs))]
    observations = [envs.observation]
    actives, actions, rewards = [], [], []
    for played in play(envs, act):
        observations.append(played.step.observation)
        actives.append(played.active & ~envs.lost)
        actions.append(played.action)
        rewards.append(played.step.reward)
        reads.append(_copied(read(envs)))
        tick(int(np.count_nonzero(played.active)))
    return Recording(
        start=start,
        observation=np.stack(observations).astype(np.float32),
        arrays={name: np.stack([each[name] for each in reads]) for name in reads[0]},
        action=np.stack(actions),
        reward=np.stack(rewards).astype(np.float32),
        terminated=envs.terminated,
        truncated=envs.truncated,
        length=np.stack(actives).sum(axis=0, dtype=np.int32),
        missing=envs.missing.copy(),
    )


def _copied(arrays: Mapping[str, Array]) -> dict[str, Array]:
    return {name: values.copy() for name, values in arrays.items()}


class Outcome(NamedTuple):
    """What came of n whole episodes."""

    returns: Array  # (n,)
    numbers: list[Numbers]  # that each episode's `info` told at its end


def joined(outcomes: Iterable[Outcome], count: int | None = None) -> Outcome:
    """The first `count` episodes of several outcomes; None is all."""
    returns, numbers = zip(*outcomes, strict=True)
    return Outcome(np.concatenate(returns)[:count], [*chain(*numbers)][:count])


def outcome(
    envs: Environments, act: Actor, first_seed: int = 0, tick: Tick = lambda steps: None
) -> Outcome:
    """What comes of one whole episode in each environment under a policy.

    Environment i starts like a Gymnasium environment reset with `first_seed` + i.
    """
    envs.reset(range(envs.num_envs), range(first_seed, first_seed + envs.num_envs))
    total = np.zeros(envs.num_envs)
    for played in play(envs, act):
        total += played.step.reward
        tick(int(played.active.sum()))
    return Outcome(total, envs.numbers)


def whole_outcome(
    envs: Environments, begin: Callable[[], Actor], first_seed: int, tick: Tick = lambda steps: None
) -> Outcome:
    """As `outcome`; episodes in which the environment failed are begun and played again."""
    while True:
        found = outcome(envs, begin(), first_seed, tick)
        if not envs.has_failed:
            return found
