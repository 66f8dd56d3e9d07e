"""Fitted Q-iteration on a code: what can be learned of acting from stored steps alone.

Twice: by trees, to which the scale of a code doesn't matter (Ernst, Geurts and Wehenkel 2005,
"Tree-based batch mode reinforcement learning", JMLR 6), and by ridge regression on random Fourier
features (Rahimi and Recht 2007), to which it does. What trees find and the other doesn't, the code
knows but hides: it is badly conditioned.

Both keep their structure while targets change, trees their splits and features their frequencies,
so that an iteration is a few sums, and with trees it converges (Gordon 1995).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Array
from jbrep.worth.steps import Transitions

Codes = NDArray[np.float32]  # (n, l)
Actions = NDArray[np.float32]  # (n, k), in [-1, 1]
Choose = Callable[[Codes], Actions]

BACKUPS = 100
_NUMBERS = 1 << 26  # of codes that are prepared at once: 256 MiB
_TREES, _LEAF = 30, 8  # trees, and the fewest steps in a leaf
_FEATURES, _PENALTY = 400, 1e-3
_PAIRS = 500  # rows whose distances give the features their width


class Coded(NamedTuple):
    """Held steps as a code shows them: before and after, (n, l) each."""

    code: Codes
    next_code: Codes
    held: Transitions


class Values(Protocol):
    """A regression of values on codes and actions, of a structure that stays."""

    def prepare(self, codes: Codes, actions: Actions) -> Any:
        """Codes (n, l) with an action each, (n, k), as `at` takes them."""

    def fit(self, wanted: Array) -> None:
        """Fit to a value of each step that the structure was made of, (n,)."""

    def at(self, prepared: Any) -> Array:
        """The values there, (n,)."""


class Trees:
    """Extremely randomised trees (Geurts et al. 2006), split by rewards, ends, changes of codes."""

    def __init__(self, steps: Coded):
        from sklearn.ensemble import ExtraTreesRegressor  # not at the top: it takes seconds

        given = np.hstack((steps.code, steps.held.action))
        held = steps.held
        split_by = np.column_stack((held.reward, held.continues, steps.next_code - steps.code))
        deviation = split_by.std(axis=0)
        split_by = split_by[:, deviation > 0] / deviation[deviation > 0]
        if not split_by.size:
            split_by = np.zeros((len(given), 1))
        forest = ExtraTreesRegressor(_TREES, min_samples_leaf=_LEAF, random_state=0)
        self._forest = forest.fit(given, split_by if split_by.shape[1] > 1 else split_by[:, 0])
        nodes = [tree.tree_.node_count for tree in forest.estimators_]
        self._first, self._nodes = np.cumsum([0, *nodes[:-1]]), sum(nodes)
        self._leaves = self.prepare(steps.code, steps.held.action)
        self._counts = np.maximum(np.bincount(self._leaves.ravel(), minlength=self._nodes), 1)
        self._value = np.zeros(self._nodes)

    def prepare(self, codes: Codes, actions: Actions) -> NDArray[np.int32]:
        """The leaf of each tree, (n, trees)."""
        found = self._forest.apply(np.hstack((codes, actions))) + self._first
        return found.astype(np.int32)

    def fit(self, wanted: Array) -> None:
        """As for `Values`: a leaf's value is the mean of its steps."""
        weights = np.repeat(wanted, _TREES)
        self._value = np.bincount(self._leaves.ravel(), weights, self._nodes) / self._counts

    def at(self, prepared: NDArray[np.int32]) -> Array:
        """As for `Values`: the mean over the trees."""
        return self._value[prepared].mean(axis=1)


class Fourier:
    """Ridge regression on random Fourier features, of the code as it is.

    Codes and actions are each divided by the median distance of two of theirs, so the actions'
    units don't matter, and those of the code only relative to each other.
    """

    def __init__(self, steps: Coded):
        random = np.random.default_rng(0)
        parts = steps.code, steps.held.action
        self._width = [_median_distance(part, random) for part in parts]
        sizes = [part.shape[1] for part in parts]
        self._frequency = random.normal(size=(sum(sizes), _FEATURES)).astype(np.float32)
        self._phase = random.uniform(0, 2 * np.pi, _FEATURES).astype(np.float32)
        self._seen = self.prepare(*parts)
        energy = self._seen.T.astype(np.float64) @ self._seen
        ridge = _PENALTY * np.trace(energy) / _FEATURES
        self._solve = np.linalg.inv(energy + ridge * np.eye(_FEATURES))
        self._mean, self._weight = 0.0, np.zeros(_FEATURES, np.float32)

    def prepare(self, codes: Codes, actions: Actions) -> NDArray[np.float32]:
        """The features of each, (n, features)."""
        parts = zip((codes, actions), self._width, strict=True)
        given = np.hstack([part / width for part, width in parts]).astype(np.float32)
        features = given @ self._frequency
        features += self._phase
        return np.cos(features, out=features)

    def fit(self, wanted: Array) -> None:
        """As for `Values`."""
        self._mean = float(wanted.mean())
        weight = self._solve @ (self._seen.T @ (wanted - self._mean))
        self._weight = weight.astype(np.float32)

    def at(self, prepared: NDArray[np.float32]) -> Array:
        """As for `Values`."""
        return (prepared @ self._weight).astype(np.float64) + self._mean


def _median_distance(rows: NDArray[np.float32], random: np.random.Generator) -> float:
    """The median distance of two different ones of the rows (n, p); 1 where all are the same."""
    some = rows[random.integers(0, len(rows), 2 * _PAIRS)].astype(np.float64)
    distances = np.linalg.norm(some[:_PAIRS] - some[_PAIRS:], axis=1)
    apart = distances[distances > 0]
    return float(np.median(apart)) if len(apart) else 1.0


def q_iteration(values: Values, steps: Coded, gamma: float, tries: Actions) -> Choose:
    """Learn what the best action is worth from each code.

    Args:
        values: of a structure made of the steps; it is fitted.
        steps: to learn from.
        gamma: the discount of a held step.
        tries: actions that can be chosen, (m, k).

    Returns:
        What chooses the action of the highest value.
    """

    def prepared(codes: Codes) -> Any:
        parts = np.array_split(codes, 1 + codes.size * len(tries) // _NUMBERS)
        return np.concatenate(
            [
                values.prepare(np.repeat(part, len(tries), axis=0), np.tile(tries, (len(part), 1)))
                for part in parts
            ]
        )

    def of_each(prepared: Any) -> Array:
        return values.at(prepared).reshape(-1, len(tries))

    next_code = prepared(steps.next_code)
    backup(values, steps.held, gamma, lambda: of_each(next_code).max(axis=1), BACKUPS)
    return lambda codes: tries[of_each(prepared(codes)).argmax(axis=1)]


def backup(
    values: Values,
    held: Transitions,
    gamma: float,
    ahead: Callable[[], Array],
    times: int,
) -> None:
    """Fit values to rewards and what comes after, again and again.

    Args:
        values: to fit.
        held: the steps.
        gamma: the discount of a held step.
        ahead: by the values of now, what comes after each step, (n,).
        times: how often.
    """
    least, largest = held.reward.min() / (1 - gamma), held.reward.max() / (1 - gamma)
    if not held.continues.all():  # nothing comes after an end
        least, largest = min(least, 0.0), max(largest, 0.0)
    wanted = held.reward
    for _ in range(times):
        values.fit(wanted)
        wanted = held.reward + gamma * held.continues * np.clip(ahead(), least, largest)
    values.fit(wanted)
