"""Scaling observations to about [-1, 1], and angles to their sine and cosine."""

import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.columns import Column
from jbrep.envs.task import Feature, Task
from jbrep.errors import InputError

Rows = NDArray[np.int64]
Range = tuple[NDArray[Any], NDArray[Any]]  # what becomes -1 and 1, (d,) each

EXTREMA = "extrema"  # the paper's
_DEVIATIONS = 3  # standard deviations that become 1
_QUANTILES = (0.01, 0.5, 0.99)
_SAMPLED = 500_000  # rows, for quantiles
_MAX_MAGNITUDE = 1e12  # of a usual range, beyond which scaling would leave nothing


@dataclass(frozen=True, eq=False)
class Scaler:
    """Scales each feature so that two values become -1 and 1, and a constant one to 0.

    Its numbers are NumPy arrays or torch tensors, as are the values that it takes.

    Attributes:
        low: the values that become -1, (d,).
        high: the values that become 1, (d,).
        angles: places of features that become their sine; their cosines follow all features.
        clip: scaled values stay within [-clip, clip]; None for no limit.
    """

    low: Any
    high: Any
    angles: tuple[int, ...] = ()
    clip: float | None = None

    @cached_property
    def half_width(self) -> Any:
        """What each feature is divided by, (d,); 1 for a constant one."""
        half_width = (self.high - self.low) / 2
        half_width[half_width == 0] = 1
        return half_width

    @cached_property
    def centre(self) -> Any:
        """The value of each feature that is scaled to 0, (d,)."""
        return (self.high + self.low) / 2

    @property
    def size(self) -> int:
        """Numbers that an observation becomes: d, and one more for each angle."""
        return len(self.low) + len(self.angles)

    def scale(self, values: Any) -> Any:
        """Physical units (..., d) to scaled ones (..., size).

        Values outside [low, high] go beyond [-1, 1], as far as the limit allows.
        """
        scaled = (values - self.centre) / self.half_width
        if self.clip is not None:
            scaled = scaled.clip(-self.clip, self.clip)
        if not self.angles:
            return scaled
        library, angles = library_of(values), list(self.angles)
        turned = values[..., angles]
        scaled[..., angles] = library.sin(turned)
        return library.concatenate((scaled, library.cos(turned)), -1)

    def unscale(self, scaled: Any) -> Any:
        """Scaled values (..., size) to physical units (..., d): the inverse of `scale`.

        An angle lies within half a turn of the middle of its range.
        """
        size = len(self.low)
        values = scaled[..., :size] * self.half_width + self.centre
        if self.angles:
            library, angles = library_of(scaled), list(self.angles)
            turned = library.arctan2(scaled[..., angles], scaled[..., size:])
            values[..., angles] = wrapped(turned - self.centre[angles]) + self.centre[angles]
        return values

    def error(self, values: Any, others: Any) -> Any:
        """The difference of values (..., d) from others, in half widths.

        Of angles that become sine and cosine it is the one round the circle.
        """
        difference = values - others
        if self.angles:
            angles = list(self.angles)
            difference[..., angles] = wrapped(difference[..., angles])
        return difference / self.half_width


def wrapped(angle: Any) -> Any:
    """Angles [rad] within half a turn of 0."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def library_of(values: Any) -> Any:
    """The library of an array: NumPy, or torch."""
    return sys.modules["torch"] if type(values).__module__ == "torch" else np


def fit_scaler(
    scaling: str,
    task: Task,
    column: Column,
    rows: Rows,
    angles: bool = False,
    clip: float | None = None,
) -> Scaler:
    """A scaling of observations.

    Args:
        scaling: a key of SCALINGS.
        task: of the observations.
        column: of observations (N, d).
        rows: that it is fitted to.
        angles: whether angles become sine and cosine.
        clip: scaled values stay within [-clip, clip]; None for no limit.

    Raises:
        InputError: the task has no usual range of a feature, where that is needed.
    """
    low, high = SCALINGS[scaling](task, column, rows)
    places = tuple(i for i, each in enumerate(task.features) if angles and each.is_angle)
    return Scaler(low.astype(np.float32), high.astype(np.float32), places, clip)


def _extrema(task: Task, column: Column, rows: Rows) -> Range:
    return extrema(column.parts(rows))


def extrema(parts: Iterable[NDArray[Any]]) -> Range:
    """Least and greatest values of rows (n, d) in parts, (d,) each."""
    ends = [(values.min(axis=0), values.max(axis=0)) for values in parts]
    low, high = zip(*ends, strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


def _nominal(task: Task, column: Column, rows: Rows) -> Range:
    ranges = [usual_range(feature) for feature in task.features]
    if missing := [f.name for f, r in zip(task.features, ranges, strict=True) if r is None]:
        raise InputError(
            f"{task.name} has no usual range of {missing[0]}: choose another scaling than nominal"
        )
    low, high = np.array(ranges).T
    return low, high


def usual_range(feature: Feature) -> tuple[float, float] | None:
    """The usual range of a feature, unless it is too wide for scaling to leave anything."""
    if feature.low is None or feature.high is None:
        return None
    low, high = np.float32(feature.low), np.float32(feature.high)
    return (feature.low, feature.high) if -_MAX_MAGNITUDE < low < high < _MAX_MAGNITUDE else None


def _standard(task: Task, column: Column, rows: Rows) -> Range:
    mean, std = mean_and_std(column.parts(rows))
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


def _robust(task: Task, column: Column, rows: Rows) -> Range:
    step = -(-len(rows) // _SAMPLED)
    values = np.concatenate(list(column.parts(rows[::step])))
    low, median, high = np.quantile(values.astype(np.float64), _QUANTILES, axis=0)
    half_width = (high - low) / 2
    return median - half_width, median + half_width


SCALINGS: dict[str, Callable[[Task, Column, Rows], Range]] = {
    EXTREMA: _extrema,  # minimum and maximum
    "nominal": _nominal,  # the task's usual ranges
    "standard": _standard,  # the mean, and three standard deviations to either side
    "robust": _robust,  # the median, and half the distance from the 1 % to the 99 % quantile
}
