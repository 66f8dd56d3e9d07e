"""Views over all shards of a data set, and the scaling that is fitted to them."""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.errors import InputError

Array = NDArray[Any]

_CHUNK = 1 << 16  # rows at a time where all are looked at


class Column:
    """A column of a data set as one array over its shards; nothing is copied before it is indexed.

    Index it like an array: rows by number, slice, array of numbers in any order, or mask, then
    the rest. `numpy.asarray(column)` copies all of it.

    Args:
        part: gives the column's part in a shard of that number, (rows, ...).
        ends: row number after each shard's last.
        dtype: of the values.
        row: shape of one row.
    """

    def __init__(
        self,
        part: Callable[[int], Array],
        ends: Sequence[int],
        dtype: np.dtype[Any],
        row: tuple[int, ...],
    ):
        self._part = part
        self._ends = ends
        self.dtype = dtype
        self.shape = (ends[-1] if ends else 0, *row)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: int | slice | ArrayLike | tuple[Any, ...]) -> Array:
        if isinstance(rows, tuple):
            first, *others = rows or (slice(None),)
            if any(np.ndim(other) for other in others if not isinstance(other, slice)):
                raise IndexError("only the first axis takes an array: index its result again")
            before = () if np.ndim(first) == 0 and not isinstance(first, slice) else (slice(None),)
            return self[first][(*before, *others)]
        if isinstance(rows, slice):
            return self._slice(*rows.indices(len(self)))
        numbers = np.asarray(rows)
        if numbers.dtype == bool:
            if numbers.shape != (len(self),):
                raise IndexError(f"a mask of shape {numbers.shape}: {(len(self),)} is needed")
            numbers = numbers.nonzero()[0]
        if numbers.size and numbers.dtype.kind not in "iu":
            raise IndexError(f"rows of type {numbers.dtype}: numbers, a slice or a mask are needed")
        numbers = numbers.astype(np.int64)
        if numbers.size and (numbers.min() < -len(self) or numbers.max() >= len(self)):
            raise IndexError(f"rows from {numbers.min()} to {numbers.max()}: there are {len(self)}")
        return self._take(np.where(numbers < 0, numbers + len(self), numbers))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        if copy is False:
            raise ValueError("a column over shards is copied when made an array")
        values = self[:]
        return values.astype(dtype or self.dtype, copy=not values.flags.owndata)

    def __iter__(self) -> Iterator[Array]:
        for chunk in self.chunks():
            yield from chunk

    def chunks(self, size: int = _CHUNK) -> Iterator[Array]:
        """All rows in order, in views of at most that many."""
        for shard in range(len(self._ends)):
            part = self._part(shard)
            for start in range(0, len(part), size):
                yield part[start : start + size]

    def parts(self, rows: NDArray[np.int64]) -> Iterator[Array]:
        """Those rows in their order, copies of some at a time."""
        for start in range(0, len(rows), _CHUNK):
            yield self[rows[start : start + _CHUNK]]

    def __repr__(self) -> str:
        return f"Column(shape={self.shape}, dtype={self.dtype}, shards={len(self._ends)})"

    def _slice(self, start: int, stop: int, step: int) -> Array:
        if step != 1:
            return self._take(np.arange(start, stop, step))
        parts = []
        shard = bisect_right(self._ends, start)
        while start < stop:
            end, part = self._ends[shard], self._part(shard)
            first = end - len(part)
            parts.append(part[start - first : stop - first])
            start, shard = min(stop, end), shard + 1
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.empty((0, *self.shape[1:]), self.dtype)

    def _take(self, rows: Array) -> Array:
        flat = rows.ravel()
        taken = np.empty((len(flat), *self.shape[1:]), self.dtype)
        owner = np.searchsorted(self._ends, flat, side="right")
        order = np.argsort(owner, kind="stable")
        bounds = np.searchsorted(owner[order], np.arange(len(self._ends) + 1))
        for shard in np.unique(owner):
            where = order[bounds[shard] : bounds[shard + 1]]
            part = self._part(int(shard))
            taken[where] = part[flat[where] - (self._ends[shard] - len(part))]
        return taken.reshape((*rows.shape, *self.shape[1:]))[()]


@dataclass(frozen=True)
class Scaler:
    """Scales each feature to [-1, 1] over the rows it was fitted on; a constant one to 0."""

    low: NDArray[np.float32]  # (d,)
    high: NDArray[np.float32]  # (d,)

    @classmethod
    def fit(cls, column: Column, rows: NDArray[np.int64]) -> "Scaler":
        """The extrema of those rows of a column (N, d)."""
        low = np.full(column.shape[1:], np.inf, column.dtype)
        high = -low
        for values in column.parts(rows):
            low = np.minimum(low, values.min(axis=0))
            high = np.maximum(high, values.max(axis=0))
        return cls(low, high)

    @cached_property
    def half_width(self) -> Array:
        """What a feature is divided by, (d,); 1 for a constant one."""
        half_width = (self.high - self.low) / 2
        half_width[half_width == 0] = 1
        return half_width

    @cached_property
    def centre(self) -> Array:
        """What becomes 0, (d,)."""
        return (self.high + self.low) / 2

    def scale(self, values: Array) -> Array:
        """Physical units (n, d) to [-1, 1]; beyond it where the fitted rows didn't reach."""
        return (values - self.centre) / self.half_width

    def unscale(self, scaled: Array) -> Array:
        """The inverse of `scale`."""
        return scaled * self.half_width + self.centre


class Batches:
    """Passes over rows of some columns, in batches, each pass in another seeded order.

    Where the rows fit in memory they are loaded once and a pass is a uniform permutation. Where
    they don't, runs of consecutive rows are drawn in random order, as many as fit, and shuffled
    among themselves; every row still comes once in a pass. Iterate for the next pass.

    Args:
        columns: by name.
        rows: row numbers to go over, sorted.
        size: rows in a batch; the last of a pass may be smaller.
        seed: of the order.
        memory: how many bytes may be held.
    """

    _RUN = 1024  # rows read together when they don't all fit

    def __init__(
        self, columns: dict[str, Column], rows: NDArray[np.int64], size: int, seed: int, memory: int
    ):
        if size < 1 or seed < 0:
            raise InputError(f"batches of {size} with seed {seed}: at least 1 and 0 are needed")
        self._columns = columns
        self._rows = rows
        self._size = size
        self._seed = seed
        self._epoch = 0
        row_bytes = sum(c.dtype.itemsize * int(np.prod(c.shape[1:])) for c in columns.values())
        self._fitting = max(self._RUN, memory // max(1, row_bytes))
        self._loaded: dict[str, Array] | None = None

    def __len__(self) -> int:
        return -(-len(self._rows) // self._size)

    @property
    def in_memory(self) -> bool:
        """Whether the rows fit."""
        return len(self._rows) <= self._fitting

    def __iter__(self) -> Iterator[dict[str, Array]]:
        random = np.random.default_rng((self._seed, self._epoch))
        self._epoch += 1
        if not self.in_memory:
            return self._from_runs(random)
        if self._loaded is None:
            self._loaded = {name: column[self._rows] for name, column in self._columns.items()}
        return self._from(self._loaded, random)

    def _from(self, loaded: dict[str, Array], random: np.random.Generator) -> Iterator[Any]:
        order = random.permutation(len(self._rows))
        for start in range(0, len(order), self._size):
            taken = order[start : start + self._size]
            yield {name: values.take(taken, axis=0) for name, values in loaded.items()}

    def _from_runs(self, random: np.random.Generator) -> Iterator[dict[str, Array]]:
        starts = random.permutation(np.arange(0, len(self._rows), self._RUN))
        together = max(1, self._fitting // (3 * self._RUN))  # old, new, and new while it is made
        left = self._rows[:0]
        for group in range(0, len(starts), together):
            runs = [self._rows[s : s + self._RUN] for s in starts[group : group + together]]
            rows = np.concatenate((left, random.permutation(np.concatenate(runs))))
            whole = len(rows) - len(rows) % self._size
            left = rows[whole:]
            values = {name: column[rows[:whole]] for name, column in self._columns.items()}
            for start in range(0, whole, self._size):
                yield {name: v[start : start + self._size] for name, v in values.items()}
        if len(left):
            yield {name: column[left] for name, column in self._columns.items()}
