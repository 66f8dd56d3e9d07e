"""A policy that does a task well: codes are judged by what they say of its actions and value."""

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.scaled import sample
from jbrep.encoders.base import BaseEncoder
from jbrep.evaluate.explained import explained
from jbrep.evaluate.held_out import HeldOut, Rows, sample_rows
from jbrep.evaluate.readout import ridge
from jbrep.evaluate.regression import Predictor, Problem
from jbrep.stats.bootstrap import Array, by_episode

GAMMA = 0.99
_PARTS = ("train", "test")
_UNKNOWN = 300  # last steps of an episode cut short, whose return to go isn't known: .99^300 = .05
_EVERY = 3  # one of three episodes is judged on
_SHARE = 0.1  # of the usual steps of training
_ROWS = 50_000  # at most, to fit on and to judge on


class PlayedEpisode(NamedTuple):
    """An episode of n steps under a policy.

    Attributes:
        observation: before each step and at the end, in physical units, (n + 1, d).
        reward: of each step, (n,).
        terminated: whether a state ended it, so that nothing more could be earned.
    """

    observation: NDArray[np.float32]
    reward: NDArray[Any]
    terminated: bool


class GoodPolicy:
    """A policy, and what it did in some episodes.

    Args:
        name: of the policy.
        act: its actions (n, k) from observations (n, d) in physical units.
        episodes: that it played.

    Attributes:
        name: as given.
        act: as given.
    """

    def __init__(
        self,
        name: str,
        act: Callable[[NDArray[Any]], NDArray[Any]],
        episodes: Sequence[PlayedEpisode],
    ):
        self.name, self.act = name, act
        self._episodes = [episode for episode in episodes if _known(episode)]

    @cached_property
    def fitted_on(self) -> "States":
        """States of two thirds of the episodes."""
        return States([e for i, e in enumerate(self._episodes) if i % _EVERY])

    @cached_property
    def judged_on(self) -> "States":
        """States of the others."""
        return States(self._episodes[::_EVERY])

    @property
    def has_value(self) -> bool:
        """Whether there are episodes to fit to and to judge on."""
        return len(self._episodes) > 1


class States:
    """A sample of the steps of some episodes, with their returns to go.

    Attributes:
        rows: numbers of the steps, (n,).
        observation: (n, d).
        value: their discounted returns to go, (n, 1).
    """

    def __init__(self, episodes: Sequence[PlayedEpisode]):
        known = [_known(e) for e in episodes]
        episode = np.repeat(np.arange(len(episodes)), known)
        self.rows = sample(np.arange(len(episode)), _ROWS)
        self._episode, self._count = episode, len(episodes)
        together = [e.observation[:n] for e, n in zip(episodes, known, strict=True)]
        self.observation = np.concatenate(together)[self.rows]
        values = [returns_to_go(e.reward)[:n] for e, n in zip(episodes, known, strict=True)]
        self.value = np.concatenate(values)[self.rows, None]

    def sums(self, rows: Rows, *values: NDArray[Any]) -> list[Array]:
        """Sums of each array (n, k) over the rows of each episode, (episodes, k)."""
        return [by_episode(v, self._episode[rows], self._count) for v in values]


def _known(episode: PlayedEpisode) -> int:
    """Steps whose return to go is known."""
    steps = len(episode.reward)
    return steps if episode.terminated else max(0, steps - _UNKNOWN)


def returns_to_go(reward: NDArray[Any]) -> Array:
    """Discounted sums of the rewards from each step on, (n,)."""
    values = np.zeros(len(reward) + 1)
    for step in reversed(range(len(reward))):
        values[step] = reward[step] + GAMMA * values[step + 1]
    return values[:-1]


def problems(encoder: BaseEncoder, held_out: HeldOut, policy: GoodPolicy) -> dict[str, Problem]:
    """The policy's `action` and `value`, its return to go, from the latent.

    No value where too few episodes are left to fit to and to judge on.
    """
    seen, taken, _ = _acting(held_out, policy, "train")
    told = {"action": Problem(encoder.encode(seen), taken)}
    if policy.has_value:
        states = policy.fitted_on
        told["value"] = Problem(encoder.encode(states.observation), states.value, share=_SHARE)
    return told


def value(
    encoder: BaseEncoder, held_out: HeldOut, policy: GoodPolicy, predict: Predictor
) -> list[float | None]:
    """R^2 of the policy's return to go, discounted by .99, from the latent, nonlinearly.

    Fitted on two thirds of its episodes, judged on the others. The last 300 steps of an episode
    are left out unless a state ended it.
    """
    states = policy.judged_on
    predicted = predict(encoder.encode(states.observation))
    return explained(predicted, states.value, states.rows, states).tolist()[0]


def action(
    encoder: BaseEncoder, held_out: HeldOut, policy: GoodPolicy, predict: Predictor
) -> dict[str, Any]:
    """R^2 of what the policy would do in held-out rows, from the latent: linear and nonlinear."""
    (seen, taken, _), (unseen, true, rows) = (_acting(held_out, policy, p) for p in _PARTS)
    latent = encoder.encode(unseen)
    linear = ridge(encoder.encode(seen), taken)
    predicted = {"linear": linear(latent), "nonlinear": predict(latent)}
    return {
        name: explained(each, true, rows, held_out).tolist()[0] for name, each in predicted.items()
    }


@lru_cache(2)  # since all encoders share them
def _acting(
    held_out: HeldOut, policy: GoodPolicy, part: str
) -> tuple[NDArray[np.float32], Array, Rows]:
    """A sample of observations (n, d), what the policy would do (n, k), and their rows (n,)."""
    data = held_out.data
    rows = sample_rows(getattr(data, part), _ROWS, data.task.size)
    observation = data.dataset["observation"][rows]
    return observation, np.asarray(policy.act(observation), np.float64), rows
