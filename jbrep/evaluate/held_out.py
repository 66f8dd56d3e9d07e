"""The held-out episodes that encoders are judged on, and R^2 with intervals over episodes."""

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from itertools import pairwise
from threading import Lock
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.errors import InputError
from jbrep.evaluate.evaluation import Score, scores
from jbrep.evaluate.truth import Columns, every
from jbrep.stats.bootstrap import Array, bootstrap, by_episode, r_squared, variation

Rows = NDArray[np.int64]
_T = TypeVar("_T")

MAX_GROUPS = 1000  # of episodes, to resample
MAX_NUMBERS = 1 << 23  # in an array of sampled rows: 64 MiB


def sample_rows(rows: Rows, most: int, width: int) -> Rows:
    """A sample of at most `most` rows, fewer where `width` numbers of each take much memory."""
    return sample(rows, max(2, min(most, MAX_NUMBERS // width)))


class HeldOut:
    """Held-out rows of a data set, by episode.

    Sums are of groups of episodes, which intervals resample: a group for each episode or, of more
    than 1,000 episodes, 1,000 groups of neighbouring ones, equally many in each give or take one.

    Args:
        data: the data set, split and scaled.
        truth: that it was derived from, of the same motion, if it shows more.

    Attributes:
        data: as given.
        hidden: names of the features that the truth alone shows.
        numbers: of the held-out episodes within the data set, (episodes,).
        num_groups: groups of episodes.
    """

    def __init__(self, data: ScaledDataset, truth: Dataset | None = None):
        self.data, self._truth = data, truth
        self.hidden = hidden_of(data.dataset, truth) if truth else ()
        self._ends = np.cumsum(data.dataset.episodes["length"], dtype=np.int64)
        self.numbers = np.unique(self._episode(data.test))
        self.num_groups = min(len(self.numbers), MAX_GROUPS)
        self._found: dict[tuple[Any, ...], Any] = {}
        self._lock = Lock()

    def once(self, compute: Callable[..., _T], *given: Any) -> _T:
        """What a function makes of this and of what else is given, computed for the first only."""
        with self._lock:
            if (compute, *given) not in self._found:
                self._found[compute, *given] = compute(self, *given)
            found: _T = self._found[compute, *given]
        return found

    def __len__(self) -> int:
        return len(self.numbers)

    def truth(self, rows: Rows) -> Columns:
        """What isn't seen in rows, (n, k) by its name; angles as cosine and sine."""
        if not self._truth:
            return {}
        known = every(self._truth.task, self._truth["observation"][rows])
        return {name: known[name] for name in self.hidden}

    def _episode(self, rows: Rows) -> Rows:
        return np.searchsorted(self._ends, rows, side="right")

    def place(self, rows: Rows) -> Rows:
        """The position of each held-out row's episode among the held-out ones, (n,)."""
        return np.searchsorted(self.numbers, self._episode(rows))

    def _group(self, rows: Rows) -> Rows:
        return self.place(rows) * self.num_groups // len(self)

    def slices(self, rows: Rows) -> list[slice]:
        """Where the rows of each group are among these."""
        bounds = np.searchsorted(self._group(rows), np.arange(self.num_groups + 1)).tolist()
        return [slice(*pair) for pair in pairwise(bounds)]

    def followed(self, rows: Rows) -> Rows:
        """Those rows whose next row belongs to the same episode."""
        return rows[self._ends[self._episode(rows)] > rows + 1]

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

    @cached_property
    def row_counts(self) -> Array:
        """Rows of each group, (groups, 1)."""
        return self.sums(self.data.test, np.ones((len(self.data.test), 1)))[0]

    @cached_property
    def variation(self) -> list[Array]:
        """Sums of scaled features and of their squares over each group, (groups, d)."""
        scaled = (chunk.astype(np.float64) for chunk in self.data.chunks(self.data.test))
        return self.sums_of_parts(self.data.test, ((chunk, chunk**2) for chunk in scaled))


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


class Episodes(Protocol):
    """Rows by episode."""

    def sums(self, rows: NDArray[np.int64], *values: NDArray[Any]) -> list[Array]:
        """Sums of each array (n, k) over the rows of each episode, (episodes, k)."""


def explained(
    predicted: NDArray[Any],
    true: NDArray[Any],
    rows: NDArray[np.int64],
    episodes: Episodes,
    widths: Sequence[int] | None = None,
    means: Sequence[NDArray[Any]] = (),
) -> list[Score]:
    """R^2 of each part of predicted columns (n, k); the columns of a part count together.

    Args:
        predicted: the columns.
        true: what they should be, (n, k).
        rows: their rows, (n,).
        episodes: of the rows, to resample.
        widths: of the parts; None for all columns as one part.
        means: weights of the parts, (parts,), in weighted means of those that vary, which come as
            further parts at the end.
    """
    true = np.asarray(true, np.float64)
    shifted = true - true.mean(axis=0)  # keeps the digits of a small variation
    sums = episodes.sums(
        rows, (predicted - true) ** 2, shifted, shifted**2, np.ones((len(rows), 1))
    )
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
