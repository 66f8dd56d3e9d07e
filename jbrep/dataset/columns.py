"""Columns over all shards of a data set, and shuffled batches of them."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.errors import InputError

Array = NDArray[Any]

_CHUNK = 1 << 16  # rows processed at a time, at most
_CHUNK_NUMBERS = 1 << 22  # in those rows: fewer of them where they are wide


@dataclass(frozen=True, eq=False, repr=False)
class Column:
    """A column of a data set as one array over its shards; nothing is copied before it is indexed.

    Index it like an array: first the rows, by number, slice, array of numbers in any order, or
    mask, then the other axes. `numpy.asarray(column)` copies all of it.

    Attributes:
        part: returns the column's rows in the shard of a given number, (rows, ...).
        ends: cumulative number of rows after each shard.
        dtype: of the values.
        row: shape of one row.
    """

    part: Callable[[int], Array]
    ends: Sequence[int]
    dtype: np.dtype[Any]
    row: tuple[int, ...]

    def __len__(self) -> int:
        return self.ends[-1] if self.ends else 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return (len(self), *self.row)

    def __getitem__(self, rows: int | slice | ArrayLike | tuple[Any, ...]) -> Array:
        if isinstance(rows, tuple):
            first, *others = rows or (slice(None),)
            if any(np.ndim(other) for other in others if not isinstance(other, slice)):
                raise IndexError("only the first axis can be indexed by an array: index the result")
            found = self[first]
            return found[(*[slice(None)] * (found.ndim - len(self.row)), *others)]
        if isinstance(rows, slice):
            return self._slice(*rows.indices(len(self)))
        numbers = np.asarray(rows)
        if numbers.dtype == bool:
            if numbers.shape != (len(self),):
                raise IndexError(f"the mask has shape {numbers.shape}: it must be {(len(self),)}")
            numbers = numbers.nonzero()[0]
        if numbers.size and numbers.dtype.kind not in "iu":
            raise IndexError(
                f"rows are indexed by integers, a slice or a mask, not by {numbers.dtype}"
            )
        numbers = numbers.astype(np.int64)
        if numbers.size and (numbers.min() < -len(self) or numbers.max() >= len(self)):
            raise IndexError(
                f"rows {numbers.min()} to {numbers.max()} are out of range: there are {len(self)}"
            )
        return self._take(np.where(numbers < 0, numbers + len(self), numbers))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        if copy is False:
            raise ValueError("a column can't become an array without a copy")
        values = self[:]
        return values.astype(dtype or self.dtype, copy=not values.flags.owndata)

    def __iter__(self) -> Iterator[Array]:
        for chunk in self.chunks():
            yield from chunk

    def chunks(self, size: int = _CHUNK) -> Iterator[Array]:
        """All rows in order, in views of at most `size` rows."""
        first = 0
        for shard, end in enumerate(self.ends):
            for start in range(0, end - first, size):
                yield self.part(shard)[start : start + size]  # its file is looked at each time
            first = end

    def parts(self, rows: NDArray[np.int64]) -> Iterator[Array]:
        """The given rows in their order, copied some at a time."""
        size = max(1, min(_CHUNK, _CHUNK_NUMBERS // math.prod(self.row)))
        for start in range(0, len(rows), size):
            yield self[rows[start : start + size]]

    def __repr__(self) -> str:
        return f"Column(shape={self.shape}, dtype={self.dtype}, shards={len(self.ends)})"

    def _slice(self, start: int, stop: int, step: int) -> Array:
        if step != 1:
            return self._take(np.arange(start, stop, step))
        parts = []
        shard = bisect_right(self.ends, start)
        while start < stop:
            end, part = self.ends[shard], self.part(shard)
            first = end - len(part)
            parts.append(part[start - first : stop - first])
            start, shard = min(stop, end), shard + 1
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.empty((0, *self.row), self.dtype)

    def _take(self, rows: Array) -> Array:
        flat = rows.ravel()
        taken = np.empty((len(flat), *self.row), self.dtype)
        owner = np.searchsorted(self.ends, flat, side="right")
        order = np.argsort(owner, kind="stable")
        bounds = np.searchsorted(owner[order], np.arange(len(self.ends) + 1))
        for shard in np.unique(owner):
            where = order[bounds[shard] : bounds[shard + 1]]
            part = self.part(int(shard))
            taken[where] = part[flat[where] - (self.ends[shard] - len(part))]
        return taken.reshape((*rows.shape, *self.row))[()]


class Batches:
    """Passes over rows of some columns in shuffled batches; each iteration is the next pass.

    If the rows fit in memory, they are loaded once and a pass is a uniform permutation. If they
    don't, runs of consecutive rows are drawn in random order, as many as fit, and shuffled
    together; every row still comes exactly once in a pass.

    Args:
        columns: by name.
        rows: sorted row numbers.
        size: rows per batch; the last of a pass may be smaller.
        seed: of the order.
        memory: limit of the rows held in memory [bytes].
    """

    _RUN = 1024  # consecutive rows read together if they don't all fit

    def __init__(
        self, columns: dict[str, Column], rows: NDArray[np.int64], size: int, seed: int, memory: int
    ):
        if size < 1 or seed < 0:
            raise InputError(
                f"the batch size is {size} and the seed {seed}: they must be at least 1 and 0"
            )
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
        """Whether the rows fit in memory."""
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
