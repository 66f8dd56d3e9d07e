"""What a controller needs of the state: a good policy's action and value; what latents lose."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from jbrep.coordinates import make_coordinates
from jbrep.dataset.scaled import sample
from jbrep.encoders.base import BaseEncoder
from jbrep.errors import InputError
from jbrep.evaluation.evaluation import (
    Judged,
    Lost,
    Scalar,
    Score,
    Scores,
    diagnostic,
    nearest_horizon,
)
from jbrep.evaluation.held_out import HeldOut, Rows, explained, sample_rows
from jbrep.evaluation.prediction import Matters, following
from jbrep.evaluation.regression import Networks, Problem, fit
from jbrep.stats.bootstrap import Array, by_episode

GAMMA = 0.99
_UNKNOWN = 300  # last steps of an episode cut short, whose return to go isn't known: .99^300 = .05
_FOLDS = 3  # of the episodes: values in each are judged by what was fitted to the others
_SHARE = 0.1  # of the usual steps of training
_ROWS = 50_000  # at most, to fit on and to judge on
_NEEDED = 0.1  # need from which a feature is needed
_KEPT = 0.5  # R^2 from which it is kept
_PREDICTABLE = 0.1  # R^2 below which nothing can be learnt about what a prediction needs
_SPARE = 0.02  # of the variance, by which an error may be larger and count as no worse
_NUMBERS = 1 << 18  # rows times features, at most, in which features are shuffled


class PlayedEpisode(NamedTuple):
    """An episode of n steps under a policy."""

    observation: NDArray[np.float32]  # before each step and at the end, (n + 1, d), physical units
    reward: NDArray[Any]  # of each step, (n,)
    terminated: bool  # whether a state ended it, so that nothing more could be earned


@dataclass(frozen=True, eq=False)
class GoodPolicy:
    """A policy, and what it did in some episodes."""

    name: str
    act: Callable[[NDArray[Any]], NDArray[Any]]  # actions (n, k) from observations (n, d)
    episodes: Sequence[PlayedEpisode]

    @cached_property
    def states(self) -> "States | None":
        """States whose return to go is known; None where too few episodes have any."""
        known = [episode for episode in self.episodes if _known(episode)]
        return States(known) if len(known) > 1 else None


class States:
    """A sample of the steps of some episodes, with their returns to go.

    Attributes:
        rows: numbers of the steps, (n,).
        observation: (n, d).
        value: their discounted returns to go, (n, 1).
        folds: by name, which of them are in each fold, (n,) each; whole episodes are.
    """

    def __init__(self, episodes: Sequence[PlayedEpisode]):
        known = [_known(e) for e in episodes]
        self._episode = np.repeat(np.arange(len(episodes)), known)
        self._count = len(episodes)
        self.rows = sample(np.arange(len(self._episode)), _ROWS)
        together = [e.observation[:n] for e, n in zip(episodes, known, strict=True)]
        self.observation = np.concatenate(together)[self.rows]
        values = [returns_to_go(e.reward)[:n] for e, n in zip(episodes, known, strict=True)]
        self.value = np.concatenate(values)[self.rows, None]
        fold = self._episode[self.rows] % _FOLDS
        self.folds = {f"value {i}": fold == i for i in range(min(_FOLDS, len(episodes)))}

    def sums(self, rows: Rows, *values: NDArray[Any]) -> list[Array]:
        """Sums of each array (n, k) over the rows of each episode, (episodes, k)."""
        return [by_episode(v, self._episode[rows], self._count) for v in values]


def _known(episode: PlayedEpisode) -> int:
    steps = len(episode.reward)
    return steps if episode.terminated else max(0, steps - _UNKNOWN)


def returns_to_go(reward: NDArray[Any]) -> Array:
    """Discounted sums of the rewards from each step on, (n,)."""
    backwards: Array = lfilter([1], [1, -GAMMA], reward[::-1].astype(np.float64))
    return backwards[::-1]


def problems(encoder: BaseEncoder, held_out: HeldOut, policy: GoodPolicy) -> dict[str, Problem]:
    """The policy's `action` and, in each fold of its episodes, its return to go from the latent.

    No values where too few episodes are left to fit to and to judge on.
    """
    seen, taken, _ = held_out.once(_acting, policy, "train")
    found = {"action": Problem(encoder.encode(seen), taken)}
    if states := policy.states:
        latent = encoder.encode(states.observation)
        for name, judged in states.folds.items():
            found[name] = Problem(latent[~judged], states.value[~judged], share=_SHARE)
    return found


@diagnostic(Scalar("value", "R² of a good policy's return to go", is_first=True))
def value(e: Judged) -> Score | None:
    """R^2 of the policy's return to go, discounted by .99, from the latent, nonlinearly.

    By cross-validation: each third of its episodes is judged by what was fitted to the others. The
    last 300 steps of an episode are left out unless a state ended it.
    """
    if e.policy is None or e.policy.states is None:
        return None
    states = e.policy.states
    latent, predicted = e.encoder.encode(states.observation), np.empty_like(states.value)
    for name, judged in states.folds.items():
        predicted[judged] = e.learnt.of_policy[name](latent[judged])
    return explained(predicted, states.value, states.rows, states.sums)[0]


@diagnostic(Scalar("action", "R² of a good policy's action", is_first=True))
def action(e: Judged) -> Score | None:
    """R^2 of what the policy would do in held-out rows, from the latent."""
    if e.policy is None:
        return None
    unseen, true, rows = e.held_out.once(_acting, e.policy, "test")
    predicted = e.learnt.of_policy["action"](e.encoder.encode(unseen))
    return explained(predicted, true, rows, e.held_out.sums)[0]


def _acting(
    held_out: HeldOut, policy: GoodPolicy, part: str
) -> tuple[NDArray[np.float32], Array, Rows]:
    """A sample of observations (n, d), what the policy would do (n, k), and their rows (n,)."""
    data = held_out.data
    rows = sample_rows(getattr(data, part), _ROWS, data.task.size)
    observation = data.dataset["observation"][rows]
    return observation, np.asarray(policy.act(observation), np.float64), rows


class Needs(NamedTuple):
    """How much each feature is needed, from 0 to 1."""

    reward: Matters  # for the mean reward of the next 10 steps; None if it can't be predicted
    controller: dict[str, float]  # for that or for what a policy does, by the feature's name


def needs(
    full: BaseEncoder, held_out: HeldOut, policy: GoodPolicy | None, learnt: Networks
) -> Needs:
    """What reward and controller need of the state; nothing is known of very short episodes.

    A feature is needed for a prediction by the share of the explained variance that is lost when
    its values are shuffled among held-out rows (permutation importance; Breiman 2001). A controller
    needs it directly as much as the mean reward of the next 10 steps or, if there is a policy, its
    action or value, whichever needs it most. It needs it indirectly for the change over 10 steps
    of another feature, times how much that one is needed directly.

    Places and headings in the world aren't needed where most of what the reward depends on is among
    them, and yet it is predicted as well without them, from the task's `symmetry`: of an arm's
    finger and its target the reward sees the distance alone.
    """
    ahead = nearest_horizon(learnt.forward)
    if ahead is None:
        return Needs(None, {})
    count = max(2, _NUMBERS // held_out.data.task.size)  # rows in which features are shuffled
    steps = held_out.once(following, "test", ahead)
    rows, network = sample(np.arange(len(steps.rows)), count), learnt.forward[ahead]
    observation, actions, wanted = (
        e[rows] for e in (steps.observation, steps.action, steps.wanted)
    )

    def predict(values: NDArray[Any]) -> Array:
        return network(np.hstack((full.encode(values), actions)))

    shares = _shares(predict, observation, wanted)
    moving, reward = shares[:, :-1], shares[:, -1]
    of_policy = _of_policy(full, policy, learnt, observation) if policy else []
    direct = np.max([reward, *of_policy], axis=0)
    features = held_out.data.task.features
    world = np.array([f.kind == "point" or (f.is_angle and f.frame == "world") for f in features])
    if 2 * reward[world].sum() > reward.sum():
        error = np.square(predict(observation) - wanted)
        most = error[:, -1].mean() + _SPARE * steps.wanted[:, -1].var()
        if _error_without_the_world(held_out, ahead, rows) < most:
            reward, direct = np.where(world, 0, reward), np.where(world, 0, direct)
    need = np.maximum(direct, (moving * direct).max(axis=1)).tolist()
    names = held_out.data.task.feature_names
    return Needs(reward if reward.any() else None, dict(zip(names, need, strict=True)))


def _error_without_the_world(held_out: HeldOut, ahead: int, some: Rows) -> float:
    """Mean squared error of the reward, predicted from `symmetry`, if there is one, and actions.

    In some of the held-out rows.
    """
    coordinates = None
    with suppress(InputError):
        coordinates = make_coordinates(held_out.data.task, "symmetry")
    if coordinates is None:
        return np.inf
    train, test = (held_out.once(following, part, ahead) for part in ("train", "test"))
    values = [np.hstack((coordinates.forward(e.observation), e.action)) for e in (train, test)]
    (predict,) = fit([Problem(values[0], train.wanted[:, -1:])])
    return float(np.square(predict(values[1][some]) - test.wanted[some, -1:]).mean())


def _of_policy(
    full: BaseEncoder, policy: GoodPolicy, learnt: Networks, seen: NDArray[Any]
) -> list[Array]:
    """How much what a policy does, and its value, depend on each feature, (d,) each."""

    def shares(name: str, observation: NDArray[Any], wanted: NDArray[Any]) -> Array:
        predict = learnt.of_policy[name]
        return _shares(lambda seen: predict(full.encode(seen)), observation, wanted).max(axis=1)

    asked = [shares("action", seen, policy.act(seen))]
    if states := policy.states:
        count, of_folds = len(seen) // len(states.folds), []
        for name, judged in states.folds.items():
            some = sample(np.flatnonzero(judged), count)
            of_folds.append(shares(name, states.observation[some], states.value[some]))
        asked.append(np.mean(of_folds, axis=0))
    return asked


def _shares(
    predict: Callable[[NDArray[Any]], Array], observation: NDArray[Any], wanted: NDArray[Any]
) -> Array:
    """The share of what is explained of each target that shuffling each feature loses, (d, q).

    Targets (n, q) are predicted from observations (n, d).
    """
    random = np.random.default_rng(0)
    variance = np.var(wanted, axis=0, dtype=np.float64)
    least = np.square(predict(observation) - wanted).mean(axis=0)
    explained = variance - least
    predicted = explained > _PREDICTABLE * variance
    shares = np.zeros((observation.shape[1], wanted.shape[1]))
    for feature, column in enumerate(observation.T):
        shuffled = observation.copy()
        shuffled[:, feature] = random.permutation(column)
        more = np.square(predict(shuffled) - wanted).mean(axis=0) - least
        shares[feature, predicted] = more[predicted] / explained[predicted]
    return shares.clip(0, 1)


def lost(needed: Mapping[str, float], probes: Scores) -> tuple[Lost, ...]:
    """The needed features that nonlinear probes can't read from a latent, the most needed first."""
    return tuple(
        Lost(name=name, kept=kept, need=need)
        for name, need in sorted(needed.items(), key=lambda item: -item[1])
        if need >= _NEEDED and (kept := probes[name].value) is not None and kept < _KEPT
    )
