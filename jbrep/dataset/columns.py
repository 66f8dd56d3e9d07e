"""Columns over all shards of a data set."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
            some = range(len(self))[rows]
            return self._slice(some) if some.step == 1 else self._take(np.array(some, np.int64))
        numbers = np.asarray(rows)
        if numbers.dtype == bool:
            if numbers.shape != (len(self),):
                raise IndexError(f"the mask has shape {numbers.shape}: it must be {(len(self),)}")
            numbers = numbers.nonzero()[0]
        if numbers.size and numbers.dtype.kind not in "iu":
            raise IndexError(f"rows are integers, a slice or a mask, not {numbers.dtype}")
        numbers = numbers.astype(np.int64)
        numbers = np.where(numbers < 0, numbers + len(self), numbers)
        if numbers.size and (numbers.min() < 0 or numbers.max() >= len(self)):
            raise IndexError(f"rows are out of range: there are {len(self)}")
        return self._take(numbers)

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
        for shard in range(len(self.ends)):
            part = self.part(shard)
            for start in range(0, len(part), size):
                yield part[start : start + size]

    def parts(self, rows: NDArray[np.int64]) -> Iterator[Array]:
        """The given rows in their order, copied some at a time."""
        size = max(1, min(_CHUNK, _CHUNK_NUMBERS // math.prod(self.row)))
        for start in range(0, len(rows), size):
            yield self[rows[start : start + size]]

    def __repr__(self) -> str:
        return f"Column(shape={self.shape}, dtype={self.dtype}, shards={len(self.ends)})"

    def _slice(self, rows: range) -> Array:
        start, shard = rows.start, bisect_right(self.ends, rows.start)
        parts = []
        while start < rows.stop:
            end, part = self.ends[shard], self.part(shard)
            first = end - len(part)
            parts.append(part[start - first : rows.stop - first])
            start, shard = end, shard + 1
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.empty((0, *self.row), self.dtype)

    def _take(self, rows: NDArray[np.int64]) -> Array:
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
