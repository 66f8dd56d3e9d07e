"""What a controller needs of the state, and what a code loses of that."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.encoding import BaseEncoder
from jbrep.evaluate.held_out import HeldOut
from jbrep.evaluate.policy import GoodPolicy, action_predictor, value_predictor
from jbrep.evaluate.prediction import Matters, following, predictors
from jbrep.stats.bootstrap import Array

_HORIZON = 10  # steps ahead
_NEEDED = 0.1  # need from which a feature is needed
_KEPT = 0.5  # R^2 from which it is kept
_FORETOLD = 0.1  # R^2 below which nothing can be learnt about what a prediction needs
_NUMBERS = 1 << 18  # rows times features, at most, in which features are shuffled


def needs(full: BaseEncoder, held_out: HeldOut, policy: GoodPolicy | None) -> dict[str, float]:
    """How much each feature is needed, from 0 to 1.

    A feature is needed for a prediction by the share of the explained variance that is lost when
    its values are shuffled among held-out rows (permutation importance; Breiman 2001). It is needed
    directly as much as for the mean reward of the next 10 steps or, if there is a policy, its
    action or value, whichever needs it most. It is needed indirectly for the change over 10 steps
    of another feature, times how much that one is needed directly.

    Args:
        full: the observation itself.
        held_out: to judge on.
        policy: that does the task well, if one is known.

    Returns:
        By the feature's name; empty where episodes are too short to look ahead.
    """
    shares = _of_forward(full, held_out)
    if shares is None:
        return {}
    count = _count(held_out)
    moving, direct = shares[:, :-1], shares[:, -1]
    if policy is not None:
        seen = following(held_out, "test", _ahead(full, held_out)).observation[:count]
        acts = action_predictor(full, held_out, policy)
        by_action = _shares(lambda seen: acts(full.encode(seen)), seen, policy.act(seen))
        direct = np.maximum(direct, by_action.max(axis=1))
        if policy.has_value:
            states, worth = policy.judged_on, value_predictor(full, policy)
            by_value = _shares(
                lambda seen: worth(full.encode(seen)),
                states.observation[:count],
                states.value[:count],
            )
            direct = np.maximum(direct, by_value[:, 0])
    need = np.maximum(direct, (moving * direct).max(axis=1))
    return dict(zip(held_out.data.task.feature_names, need.tolist(), strict=True))


def matters(full: BaseEncoder, held_out: HeldOut) -> Matters:
    """How much the mean reward of the next 10 steps depends on each feature, (d,), as `needs`.

    None where episodes are too short, or the reward can't be foretold.
    """
    shares = _of_forward(full, held_out)
    if shares is None or not shares[:, -1].any():
        return None
    return shares[:, -1]


def _ahead(full: BaseEncoder, held_out: HeldOut) -> int:
    """The number of steps ahead that is nearest to 10."""
    return min(predictors(full, held_out), key=lambda ahead: abs(ahead - _HORIZON))


def _count(held_out: HeldOut) -> int:
    """Rows in which features are shuffled."""
    return max(2, _NUMBERS // held_out.data.task.size)


@lru_cache(1)
def _of_forward(full: BaseEncoder, held_out: HeldOut) -> Array | None:
    """The share that each feature has in the prediction of each change and of the reward."""
    forward = predictors(full, held_out)
    if not forward:
        return None
    ahead, count = _ahead(full, held_out), _count(held_out)
    steps = following(held_out, "test", ahead)
    return _shares(
        lambda seen: forward[ahead](np.hstack((full.encode(seen), steps.action[:count]))),
        steps.observation[:count],
        steps.wanted[:count],
    )


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
    foretold = explained > _FORETOLD * variance
    for feature, column in enumerate(observation.T):
        shuffled = observation.copy()
        shuffled[:, feature] = random.permutation(column)
        more = error(shuffled) - least
        shares[feature, foretold] = more[foretold] / explained[foretold]
    return shares.clip(0, 1)


def lost(
    needed: Mapping[str, float], probes: Mapping[str, list[float | None]]
) -> list[dict[str, Any]]:
    """The features that are needed and can't be read from a code, the most needed first.

    Args:
        needed: as `needs` returns it.
        probes: of the code, nonlinear.

    Returns:
        The name of each, how much of it is `kept` (R^2), and its `need`.
    """
    return [
        {"name": name, "kept": kept, "need": need}
        for name, need in sorted(needed.items(), key=lambda item: -item[1])
        if need >= _NEEDED and (kept := probes[name][0]) is not None and kept < _KEPT
    ]
