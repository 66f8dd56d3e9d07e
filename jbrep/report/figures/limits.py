"""The ends of axes of returns, which differ between tasks."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jbrep.stats.bootstrap import Interval
from jbrep.stats.runs import LARGEST_RETURN

_FILLED = 1 / 3  # of an axis, at least, by the returns themselves
_BEYOND = 0.25  # of their range, for the ends of intervals on either side


class Limits(NamedTuple):
    """What an axis of returns extends over."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """Of the axis."""
        return self.high - self.low

    def contain(self, value: float) -> bool:
        """Whether a value lies within; NaN doesn't."""
        return self.low <= value <= self.high

    def with_room(self, share: float) -> tuple[float, float]:
        """The ends with some more on either side, for whole markers.

        Args:
            share: of the width.
        """
        return self.low - share * self.width, self.high + share * self.width

    def with_ends(self, intervals: Iterable[Interval], floor: float = np.nan) -> "Limits":
        """The limits with the ends of intervals, but not far beyond, nor below the floor.

        Args:
            intervals: such as of means; their ends may be NaN.
            floor: the least possible value; NaN if there is none.
        """
        least, most = self.with_room(_BEYOND)
        values = np.array([[each.value, each.low, each.high] for each in intervals], float)
        ends = np.clip(values[~np.isnan(values)], np.fmax(least, floor), most)
        return Limits(min([self.low, *ends]), max([self.high, *ends]))


def limits(returns: Iterable[float], floor: float = np.nan, solved: float = np.nan) -> Limits:
    """From the least return, or from the floor if it is known, to the largest.

    The return from which on a task counts as solved is within the limits unless it is so far off
    that the returns would fill less than a third of the axis.

    Args:
        returns: of which those that aren't finite, or beyond any return, don't count.
        floor: the least possible return; NaN if unknown.
        solved: NaN if unknown.
    """
    values = np.array([*returns, floor], float)
    values = values[np.abs(values) <= LARGEST_RETURN]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    wider = Limits(float(np.fmin(low, solved)), float(np.fmax(high, solved)))
    if high - low >= _FILLED * wider.width:
        low, high = wider
    return Limits(low, high) if high > low else Limits(low - 0.5, high + 0.5)
