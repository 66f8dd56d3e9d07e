"""What a controller needs of the state, and what a code loses of that."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.evaluate.held_out import HeldOut
from jbrep.evaluate.networks import networks
from jbrep.evaluate.policy import GoodPolicy
from jbrep.evaluate.prediction import Matters, following
from jbrep.evaluate.regression import Predictor
from jbrep.stats.bootstrap import Array

_HORIZON = 10  # steps ahead
_NEEDED = 0.1  # need from which a feature is needed
_KEPT = 0.5  # R^2 from which it is kept
_PREDICTABLE = 0.1  # R^2 below which nothing can be learnt about what a prediction needs
_NUMBERS = 1 << 18  # rows times features, at most, in which features are shuffled


class Needs(NamedTuple):
    """How much each feature is needed, from 0 to 1.

    Attributes:
        reward: for the mean reward of the next 10 steps, (d,); None where episodes are too short,
            or it can't be predicted.
        controller: for that, directly or not, or for what a policy does, by the feature's name;
            empty where episodes are too short.
    """

    reward: Matters
    controller: dict[str, float]


def needs(full: BaseEncoder, held_out: HeldOut, policy: GoodPolicy | None) -> Needs:
    """What reward and controller need of the state.

    A feature is needed for a prediction by the share of the explained variance that is lost when
    its values are shuffled among held-out rows (permutation importance; Breiman 2001). A controller
    needs it directly as much as the mean reward of the next 10 steps or, if there is a policy, its
    action or value, whichever needs it most. It needs it indirectly for the change over 10 steps
    of another feature, times how much that one is needed directly.

    Args:
        full: the observation itself.
        held_out: to judge on.
        policy: that does the task well, if one is known.
    """
    learnt = networks(full, held_out, policy)
    if not learnt.forward:
        return Needs(None, {})
    ahead, count = _ahead(learnt.forward), _count(held_out)
    steps = following(held_out, "test", ahead)
    seen, told = steps.observation[:count], learnt.forward[ahead]
    inputs = steps.action[:count]
    shares = _shares(
        lambda seen: told(np.hstack((full.encode(seen), inputs))), seen, steps.wanted[:count]
    )
    moving, reward = shares[:, :-1], shares[:, -1]
    of_policy = _of_policy(full, policy, learnt.of_policy, seen) if policy else ()
    direct = np.max([reward, *of_policy], axis=0)
    need = np.maximum(direct, (moving * direct).max(axis=1)).tolist()
    names = held_out.data.task.feature_names
    return Needs(reward if reward.any() else None, dict(zip(names, need, strict=True)))


def _of_policy(
    full: BaseEncoder,
    policy: GoodPolicy,
    predictors: Mapping[str, Predictor],
    seen: NDArray[Any],
) -> Iterator[Array]:
    """How much each of what predictors say of a policy depends on each feature, (d,)."""
    count = len(seen)
    asked = {"action": (seen, policy.act(seen))}
    if policy.has_value:
        states = policy.judged_on
        asked["value"] = states.observation[:count], states.value[:count]
    for name, (observation, wanted) in asked.items():
        told = partial(_told, full, predictors[name])
        yield _shares(told, observation, wanted).max(axis=1)


def _told(full: BaseEncoder, predict: Predictor, observation: NDArray[Any]) -> Array:
    return predict(full.encode(observation))


def _ahead(horizons: Iterable[int]) -> int:
    """The number of steps ahead that is nearest to 10."""
    return min(horizons, key=lambda ahead: abs(ahead - _HORIZON))


def _count(held_out: HeldOut) -> int:
    """Rows in which features are shuffled."""
    return max(2, _NUMBERS // held_out.data.task.size)


def _shares(
    predict: Callable[[NDArray[Any]], Array], observation: NDArray[Any], wanted: NDArray[Any]
) -> Array:
    """The share of what is explained of each target that shuffling each feature loses, (d, q).

    Args:
        predict: the targets (n, q) from observations (n, d).
        observation: to shuffle, (n, d).
        wanted: the targets, (n, q).
    """
    random = np.random.default_rng(0)
    variance = np.var(wanted, axis=0, dtype=np.float64)

    def error(seen: NDArray[Any]) -> Array:
        return np.square(predict(seen) - wanted).mean(axis=0)

    least = error(observation)
    explained = variance - least
    shares = np.zeros((observation.shape[1], wanted.shape[1]))
    predicted = explained > _PREDICTABLE * variance
    for feature, column in enumerate(observation.T):
        shuffled = observation.copy()
        shuffled[:, feature] = random.permutation(column)
        more = error(shuffled) - least
        shares[feature, predicted] = more[predicted] / explained[predicted]
    return shares.clip(0, 1)


def lost(
    needed: Mapping[str, float], probes: Mapping[str, list[float | None]]
) -> list[dict[str, Any]]:
    """The features that are needed and can't be read from a code, the most needed first.

    Args:
        needed: how much a controller needs each feature.
        probes: of the code, nonlinear.

    Returns:
        The name of each, how much of it is `kept` (R^2), and its `need`.
    """
    return [
        {"name": name, "kept": kept, "need": need}
        for name, need in sorted(needed.items(), key=lambda item: -item[1])
        if need >= _NEEDED and (kept := probes[name][0]) is not None and kept < _KEPT
    ]
