"""One shard: an HDF5 file of flat columns, made in memory and read as memory maps."""

import hashlib
import math
import mmap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray

from jbrep.dataset.schema import EPISODES, Columns, Spec
from jbrep.errors import DamageError, InputError

REPAIR = "run jbrep data repair to restore it"
FileState = tuple[int, ...] | None  # see `file_state`
Checked = tuple[int, FileState]  # a shard, and the state in which its file was as it should be
_HASH = "sha256"  # attribute of every column


def column_hash(column: NDArray[Any]) -> str:
    """SHA-256 of a column's values, row by row; it identifies the data, whatever the file."""
    return hashlib.sha256(np.ascontiguousarray(column).data).hexdigest()


def column_hashes(columns: Columns) -> dict[str, str]:
    """The hash of each column, by name."""
    return {name: column_hash(column) for name, column in columns.items()}


def file_hash(content: Any) -> str:
    """XXH3 of a whole file: fast enough to look for damage whenever a file is opened."""
    return xxhash.xxh3_128_hexdigest(content)


def shard_image(
    columns: Columns, hashes: Mapping[str, str], attributes: Mapping[str, Any]
) -> bytes:
    """The bytes of a shard; equal arguments give equal bytes."""
    with h5py.File.in_memory() as file:
        file.attrs.update(attributes)
        for name, column in columns.items():
            file.create_dataset(name, data=column).attrs[_HASH] = hashes[name]
        file.flush()
        return file.id.get_file_image()


def file_state(path: Path) -> FileState:
    """What changes with a file's content: inode, size and modification time; None if it's gone."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def map_file(path: Path) -> mmap.mmap:
    """Map a file into memory, read-only.

    Raises:
        DamageError: there is no such file, or it is empty.
    """
    try:
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError:
        raise DamageError(f"{path} is missing: {REPAIR}") from None
    except ValueError:
        raise DamageError(f"{path} is damaged: it is empty; {REPAIR}") from None
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error


@dataclass(frozen=True, eq=False)
class Shard(Mapping[str, NDArray[Any]]):
    """The columns of a shard as read-only views of its bytes, each checked at its first use.

    Only contiguous data inside the file itself is accepted, so HDF5 never reads any data: no link,
    external file, virtual data set or filter is followed.

    Attributes:
        path: of the shard, for messages.
        content: its bytes.
        specs: the expected columns, no more and no fewer.
        rows: how many there are.
        episodes: how many there are.
        max_length: rows of the longest episode that is possible.

    Raises:
        DamageError: at the use of a column, if the file is structured differently.
    """

    path: Path
    content: mmap.mmap
    specs: Mapping[str, Spec]
    rows: int
    episodes: int
    max_length: int
    _views: dict[str, NDArray[Any]] = field(default_factory=dict, init=False)

    def first(self, rows: int, episodes: int) -> Columns:
        """The first rows and episodes of each column."""
        return {n: self[n][: episodes if n.startswith(EPISODES) else rows] for n in self}

    def __iter__(self) -> Iterator[str]:
        return iter(self.specs)

    def __len__(self) -> int:
        return len(self.specs)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._views:
            spec = self.specs[name]
            shape = (self.episodes if name.startswith(EPISODES) else self.rows, *spec.row)
            with self._structure() as file:
                if not self._views:
                    self._check_names(file)
                offset = self._offset(h5py.h5d.open(file, name.encode()), name, spec.dtype, shape)
            count = math.prod(shape)
            if offset + count * spec.dtype.itemsize > len(self.content):
                raise self._damage(f"{name} extends beyond the end of the file")
            view = np.frombuffer(self.content, spec.dtype, count, offset).reshape(shape)
            if name == EPISODES + "length":
                self._check_lengths(view)
            self._views[name] = view
        return self._views[name]

    def _check_lengths(self, lengths: NDArray[Any]) -> None:
        """Check that the episodes have as many rows as the shard: they locate its rows."""
        if lengths.min() < 1 or lengths.max() > self.max_length or lengths.sum() != self.rows:
            raise self._damage(f"the lengths of its episodes don't add up to {self.rows:,} rows")

    def _damage(self, what: str) -> DamageError:
        return DamageError(f"{self.path} is damaged: {what}")

    @contextmanager
    def _structure(self) -> Iterator[h5py.h5f.FileID]:
        """The file as HDF5 sees it; anything that HDF5 can't parse is damage."""
        try:
            with h5py.File(self.content, "r") as file:  # at that path may be another by now
                yield file.id
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, DamageError):
                raise
            raise self._damage("it isn't an HDF5 file of flat columns") from error

    def _check_names(self, file: h5py.h5f.FileID) -> None:
        """Check that the file holds the expected columns, by hard links, and nothing else."""
        names = {name.encode() for name in self.specs}
        self._check_links(h5py.h5g.open(file, b"/"), {n.partition(b"/")[0] for n in names})
        for group in {name.rpartition(b"/")[0] for name in names} - {b""}:
            inside = {n.rpartition(b"/")[2] for n in names if n.startswith(group + b"/")}
            self._check_links(h5py.h5g.open(file, group), inside)

    def _check_links(self, group: h5py.h5g.GroupID, names: set[bytes]) -> None:
        if group.get_num_objs() != len(names):
            raise self._damage(
                f"it has {group.get_num_objs()} entries instead of the {len(names)} expected: "
                f"{b', '.join(sorted(names)).decode()}"
            )
        for name in names:
            if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
                raise self._damage(f"{name.decode()} is a link, which isn't accepted")

    def _offset(
        self, column: h5py.h5d.DatasetID, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> int:
        """Where the column begins in the file, after checking that its layout is plain."""
        layout = column.get_create_plist()
        if layout.get_layout() != h5py.h5d.CONTIGUOUS or layout.get_external_count():
            raise self._damage(f"{name} is not stored contiguously in this file")
        if column.shape != shape or column.dtype != dtype:
            raise self._damage(
                f"{name} has shape {column.shape} and type {column.dtype} instead of {shape} and "
                f"{dtype}"
            )
        offset: int | None = column.get_offset()
        if offset is None and 0 not in shape:
            raise self._damage(f"{name} was never written")
        return offset or 0
