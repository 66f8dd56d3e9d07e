"""Whether 32 bits hold what a feature tells: a clock's seconds since 1970 are one number there."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Array, Task

_LARGE = 1000.0  # below it, 32 bits hold each number to .00006
_STEPS = 10  # in which the typical change should be seen


class Signals(NamedTuple):
    """What the features of a task went through, (d,) each."""

    low: Array
    high: Array
    change: Array  # from a step to the next, the root of the mean square; 0 of a constant

    @classmethod
    def of(cls, episodes: Sequence[NDArray[np.floating]]) -> "Signals":
        """Those of the observations of some episodes, (n, d) each; what isn't finite is passed."""
        squares, count = np.zeros(episodes[0].shape[1]), 0
        low, high = squares + np.inf, squares - np.inf
        for episode in episodes:
            finite = episode[np.isfinite(episode).all(axis=1)].astype(np.float64)
            low = np.minimum(low, finite.min(axis=0, initial=np.inf))
            high = np.maximum(high, finite.max(axis=0, initial=-np.inf))
            squares += (np.diff(finite, axis=0) ** 2).sum(axis=0)
            count += max(len(finite) - 1, 0)
        return cls(low, high, np.sqrt(squares / max(count, 1)))

    def plus(self, offset: Array) -> "Signals":
        """Of the features before an offset, (d,), was subtracted."""
        return Signals(self.low + offset, self.high + offset, self.change)

    def with_more(self, other: "Signals") -> "Signals":
        """Of these and others, by the larger changes."""
        return Signals(
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
            np.maximum(self.change, other.change),
        )


def precision_problems(task: Task, signals: Signals | None) -> Iterator[str]:
    """A line for each feature of which 32 bits lose what changes, with an offset that helps."""
    if signals is None:
        return
    for i, name in enumerate(task.feature_names):
        low, high = signals.low[i] - task.offset[i], signals.high[i] - task.offset[i]
        largest, change = max(abs(low), abs(high)), signals.change[i]
        if not np.isfinite(largest) or largest < _LARGE or not change:
            continue
        offset, spacing = np.floor(signals.low[i]), float(np.spacing(np.float32(largest)))
        if change < _STEPS * spacing:
            yield (
                f"{task.name}: {name} is near {signals.low[i]:.10g} and changes by about "
                f"{change:.3g} from step to step, but numbers of 32 bits are {spacing:.3g} apart "
                f"there: give it an offset in --features, such as offset = {offset:.10g}"
            )
