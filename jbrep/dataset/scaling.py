"""Scaling observations, or coordinates of them, to about [-1, 1]."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.coordinates import Coordinates
from jbrep.dataset.columns import Column
from jbrep.envs.task import Feature, Task
from jbrep.errors import InputError, matching

Rows = NDArray[np.int64]
Features = Sequence[Feature]
Parts = Callable[[Rows], Iterable[NDArray[Any]]]  # numbers of rows, in parts (n, m)
Range = tuple[NDArray[Any], NDArray[Any]]  # such as what becomes -1 and 1, (d,) each

EXTREMA = "extrema"  # the paper's
NOMINAL = "nominal"
_DEVIATIONS = 3  # standard deviations that become 1
_QUANTILES = (0.01, 0.5, 0.99)
_SAMPLED = 500_000  # rows, for quantiles
_MAX_MAGNITUDE = 1e12  # of a usual range, beyond which scaling would leave nothing


@dataclass(frozen=True, eq=False)
class Scaler:
    """Scales each number so that two values become -1 and 1, and a constant one to 0.

    Its numbers are NumPy arrays or torch tensors, as are the observations that it takes.

    Attributes:
        low: the values that become -1, (m,).
        high: the values that become 1, (m,).
        coordinates: what is scaled; None for the observations themselves.
        clip: scaled values stay within [-clip, clip]; None for no limit.
    """

    low: Any
    high: Any
    coordinates: Coordinates | None = None
    clip: float | None = None

    @cached_property
    def half_width(self) -> Any:
        """What each number is divided by, (m,); 1 for a constant one."""
        half_width = (self.high - self.low) / 2
        half_width[half_width == 0] = 1
        return half_width

    @cached_property
    def centre(self) -> Any:
        """The value of each number that is scaled to 0, (m,)."""
        return (self.high + self.low) / 2

    def moved(self, move: Callable[[Any], Any]) -> "Scaler":
        """The same with other arrays, which `move` makes of each of its own."""
        moved = replace(self, low=move(self.low), high=move(self.high))
        vars(moved).update(centre=move(self.centre), half_width=move(self.half_width))
        return moved

    @property
    def size(self) -> int:
        """Numbers m that an observation becomes."""
        return len(self.low)

    def features(self, task: Task) -> tuple[Feature, ...]:
        """What the scaled numbers of a task are."""
        return self.coordinates.features if self.coordinates else task.features

    def parts(self, task: Task) -> tuple[str, ...]:
        """What each of them is part of: a feature, or a part of the coordinates."""
        return self.coordinates.sources if self.coordinates else task.feature_names

    def places(self, names: Iterable[str], task: Task) -> list[int]:
        """Places of the scaled numbers with these names, or of parts with these, or patterns."""
        own = [each.name for each in self.features(task)]
        return sorted(matching(names, own, self.parts(task), f"{task.name} has no feature"))

    def scale(self, observation: Any) -> Any:
        """Observations (..., d) in physical units to scaled numbers (..., m).

        Values outside [low, high] go beyond [-1, 1], as far as the limit allows.
        """
        values = self.coordinates.forward(observation) if self.coordinates else observation
        scaled = (values - self.centre) / self.half_width
        return scaled if self.clip is None else scaled.clip(-self.clip, self.clip)

    def unscale(self, scaled: Any) -> Any:
        """Scaled numbers (..., m) to observations (..., d): the inverse of `scale`."""
        values = scaled * self.half_width + self.centre
        return self.coordinates.inverse(values) if self.coordinates else values


def fit_scaler(
    scaling: str,
    task: Task,
    column: Column,
    rows: Rows,
    coordinates: Coordinates | None = None,
    clip: float | None = None,
) -> Scaler:
    """A scaling, a key of SCALINGS, of observations or their coordinates, fitted to some rows."""
    features = coordinates.features if coordinates else task.features

    def parts(rows: Rows) -> Iterator[NDArray[Any]]:
        found = column.parts(rows)
        return map(coordinates.forward, found) if coordinates else found

    low, high = SCALINGS[scaling](features, parts, rows)
    return Scaler(low.astype(np.float32), high.astype(np.float32), coordinates, clip)


def extrema(parts: Iterable[NDArray[Any]]) -> Range:
    """Least and greatest values of rows (n, d) in parts, (d,) each."""
    ends = [(values.min(axis=0), values.max(axis=0)) for values in parts]
    low, high = zip(*ends, strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


def _nominal(features: Features, parts: Parts, rows: Rows) -> Range:
    ranges = {feature.name: usual_range(feature) for feature in features}
    if missing := [name for name, found in ranges.items() if found is None]:
        raise InputError(f"{missing[0]} has no usual range: choose another scaling than nominal")
    low, high = np.array([*ranges.values()]).T
    return low, high


def usual_range(feature: Feature) -> tuple[float, float] | None:
    """The usual range of a feature, unless it is too wide for scaling to leave anything."""
    if feature.low is None or feature.high is None:
        return None
    low, high = np.float32(feature.low), np.float32(feature.high)
    return (feature.low, feature.high) if -_MAX_MAGNITUDE < low < high < _MAX_MAGNITUDE else None


def _standard(features: Features, parts: Parts, rows: Rows) -> Range:
    mean, std = mean_and_std(parts(rows))
    return mean - _DEVIATIONS * std, mean + _DEVIATIONS * std


def mean_and_std(parts: Iterable[NDArray[Any]]) -> Range:
    """Mean and standard deviation of rows (n, d) in parts, (d,) each."""
    count, first, total, squares = 0, np.zeros(()), np.zeros(()), np.zeros(())
    for values in parts:
        first = first if count else values[0].astype(np.float64)
        shifted = values - first  # to keep the digits of small spreads
        total = total + shifted.sum(axis=0)
        squares = squares + np.square(shifted).sum(axis=0)
        count += len(values)
    mean = total / count
    return first + mean, np.sqrt(np.maximum(squares / count - mean**2, 0))


def _robust(features: Features, parts: Parts, rows: Rows) -> Range:
    step = -(-len(rows) // _SAMPLED)
    sampled = np.concatenate(list(parts(rows[::step])))
    low, median, high = np.quantile(sampled.astype(np.float64), _QUANTILES, axis=0)
    farthest = np.abs(sampled - median).max(axis=0)  # where nearly all rows are the same
    half_width = np.where(low == high, farthest, (high - low) / 2)
    return median - half_width, median + half_width


SCALINGS: dict[str, Callable[[Features, Parts, Rows], Range]] = {
    EXTREMA: lambda features, parts, rows: extrema(parts(rows)),  # minimum and maximum
    NOMINAL: _nominal,  # the task's usual ranges
    "standard": _standard,  # the mean, and three standard deviations to either side
    "robust": _robust,  # the median, and half the distance from the 1 % to the 99 % quantile
}
