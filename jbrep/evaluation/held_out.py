"""The held-out episodes that encoders are judged on, and R^2 with intervals over episodes."""

from collections.abc import Callable, Iterable, Sequence
from threading import Lock
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.errors import InputError
from jbrep.evaluation.evaluation import Score, scores
from jbrep.stats.bootstrap import Array, bootstrap, by_episode, r_squared, variation

Rows = NDArray[np.int64]
_T = TypeVar("_T")

_MAX_GROUPS = 1000  # of episodes, to resample
MAX_NUMBERS = 1 << 23  # in an array of sampled rows: 64 MiB


def sample_rows(rows: Rows, most: int, width: int) -> Rows:
    """A sample of at most `most` rows, fewer where `width` numbers of each take much memory."""
    return sample(rows, max(2, min(most, MAX_NUMBERS // width)))


class HeldOut:
    """Held-out rows of a data set, by episode; the truth shows more of the same motion.

    Sums are of groups of episodes, which intervals resample: a group for each episode or, of more
    than 1,000 episodes, 1,000 groups of neighbouring ones, equally many in each give or take one.

    Attributes:
        shown: the truth, if it is given.
        hidden: names of the features that the truth alone shows.
        numbers: of the held-out episodes within the data set, (episodes,).
    """

    def __init__(self, data: ScaledDataset, truth: Dataset | None = None):
        self.data, self.shown = data, truth
        self.hidden = hidden_of(data.dataset, truth) if truth else ()
        self._ends = np.cumsum(data.dataset.episodes["length"], dtype=np.int64)
        self.numbers = np.unique(self._episode(data.test))
        self.num_groups = min(len(self.numbers), _MAX_GROUPS)
        self._found: dict[tuple[Any, ...], Any] = {}
        self._lock = Lock()

    def once(self, compute: Callable[..., _T], *given: Any) -> _T:
        """What a function makes of this and of what else is given, computed for the first only."""
        with self._lock:
            if (compute, *given) not in self._found:
                self._found[compute, *given] = compute(self, *given)
            found: _T = self._found[compute, *given]
        return found

    def _episode(self, rows: Rows) -> Rows:
        return np.searchsorted(self._ends, rows, side="right")

    def _group(self, rows: Rows) -> Rows:
        place = np.searchsorted(self.numbers, self._episode(rows))  # among those held out
        return place * self.num_groups // len(self.numbers)

    def sums(self, rows: Rows, *values: NDArray[Any]) -> list[Array]:
        """Sums of each array (n, k) over the rows of each group, (groups, k)."""
        group = self._group(rows)
        return [by_episode(v, group, self.num_groups) for v in values]

    def sums_of_parts(self, rows: Rows, parts: Iterable[Sequence[NDArray[Any]]]) -> list[Array]:
        """The same of arrays too large for memory, which come a few rows at a time."""
        totals: list[Array] = []
        start = 0
        for values in parts:
            stop = start + len(values[0])
            sums = self.sums(rows[start:stop], *values)
            totals = [t + s for t, s in zip(totals, sums, strict=True)] if totals else sums
            start = stop
        return totals


def hidden_of(dataset: Dataset, truth: Dataset) -> tuple[str, ...]:
    """The features that a data set of the same motion has beside those of another."""
    if not np.array_equal(truth["action"], dataset["action"]):
        raise InputError(
            f"{truth.folder} has other actions than {dataset.folder}: the truth must be the data "
            "set that it was derived from"
        )
    shown = dataset.task.feature_names
    hidden = tuple(name for name in truth.task.feature_names if name not in shown)
    if not hidden:
        raise InputError(f"{truth.folder} shows nothing that {dataset.folder} hides")
    return hidden


def explained(
    predicted: NDArray[Any],
    true: NDArray[Any],
    rows: NDArray[np.int64],
    summed: Callable[..., list[Array]],
    widths: Sequence[int] | None = None,
    means: Sequence[NDArray[Any]] = (),
) -> list[Score]:
    """R^2 of each part of predicted columns (n, k); the columns of a part count together.

    Args:
        predicted: columns (n, k).
        true: what they should be.
        rows: their rows, (n,).
        summed: sums of arrays (n, k) over the rows of each episode, which are resampled.
        widths: of the parts; None for all columns as one part.
        means: weights (parts,) of weighted means over those that vary, further parts at the end.
    """
    true = np.asarray(true, np.float64)
    shifted = true - true.mean(axis=0)  # keeps the digits of a small variation
    sums = summed(rows, (predicted - true) ** 2, shifted, shifted**2, np.ones((len(rows), 1)))
    starts = np.cumsum([0, *(widths or [true.shape[1]])])[:-1]

    def statistic(residual: Array, total: Array, squares: Array, n: Array) -> Array:
        about_mean = variation(total, squares, n)
        parts = r_squared(*(np.add.reduceat(v, starts, axis=-1) for v in (residual, about_mean)))
        known = np.isfinite(parts)
        filled = np.where(known, parts, 0)
        for weights in means:
            weight = known @ weights
            mean = np.where(weight > 0, filled @ weights / np.where(weight > 0, weight, 1), np.nan)
            parts = np.append(parts, mean[..., None], axis=-1)
        return parts

    return scores(bootstrap(statistic, *sums))
