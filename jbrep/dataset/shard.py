"""One shard: an HDF5 file of flat columns, made in memory and read as memory maps."""

import hashlib
import math
import mmap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray

from jbrep.dataset.schema import EPISODES, Columns, Spec
from jbrep.errors import DamageError, InputError
from jbrep.files.storage import regular_size
from jbrep.jitterbug.tasks import EPISODE_STEPS

MEND = "jbrep data repair makes it again"
_HASH = "sha256"  # attribute of every column


def column_hash(column: NDArray[Any]) -> str:
    """SHA-256 of a column's values, row by row; it identifies the data, whatever the file."""
    return hashlib.sha256(np.ascontiguousarray(column).data).hexdigest()


def column_hashes(columns: Columns) -> dict[str, str]:
    """The hash of each column, by name."""
    return {name: column_hash(column) for name, column in columns.items()}


def file_hash(content: Any) -> str:
    """XXH3 of a whole file: it finds damage at the speed of memory, each time a file is read."""
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


def map_file(path: Path) -> mmap.mmap:
    """A file's bytes as they are on disk.

    Raises:
        DamageError: no such file, not a regular one, or an empty one.
        InputError: it can't be read.
    """
    try:
        if not regular_size(path):
            raise DamageError(
                f"{path} is damaged: a regular file that isn't empty is expected, and no link"
            )
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError:
        raise DamageError(f"{path} is missing: {MEND}") from None
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error


class Shard(Mapping[str, NDArray[Any]]):
    """The columns of a shard as read-only views of its bytes, each checked when first asked for.

    Nothing but contiguous data inside this very file is accepted, so HDF5 is never asked to read
    any: no link, external file, virtual data set or filter is followed.

    Args:
        path: of the shard, for the messages and for HDF5's structure.
        content: its bytes.
        specs: the columns that are expected, no more and no fewer.
        rows: how many rows each has.

    Raises:
        DamageError: when a column is asked for, if the file's structure is another.
    """

    def __init__(
        self, path: Path, content: mmap.mmap, specs: Mapping[str, Spec], rows: Mapping[str, int]
    ):
        self._path = path
        self._content = content
        self._specs = specs
        self._rows = rows
        self._views: dict[str, NDArray[Any]] = {}

    def __iter__(self) -> Iterator[str]:
        return iter(self._specs)

    def __len__(self) -> int:
        return len(self._specs)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._views:
            spec = self._specs[name]
            shape = spec.shape(self._rows[name])
            with self._structure() as file:
                if not self._views:
                    self._check_names(file)
                offset = self._offset(h5py.h5d.open(file, name.encode()), name, spec.dtype, shape)
            count = math.prod(shape)
            if offset + count * spec.dtype.itemsize > len(self._content):
                raise self._damage(f"{name} goes beyond its end")
            view = np.frombuffer(self._content, spec.dtype, count, offset).reshape(shape)
            if name == EPISODES + "length":
                self._check_lengths(view)
            self._views[name] = view
        return self._views[name]

    def _check_lengths(self, lengths: NDArray[Any]) -> None:
        """Rows are found by them."""
        rows = self._rows["step"]
        if lengths.min() < 0 or lengths.max() > EPISODE_STEPS or lengths.sum() != rows:
            raise self._damage(f"the lengths of its episodes don't add up to {rows:,} rows")

    def _damage(self, what: str) -> DamageError:
        return DamageError(f"{self._path} is damaged: {what}")

    @contextmanager
    def _structure(self) -> Iterator[h5py.h5f.FileID]:
        """The file as HDF5 sees it; what HDF5 can't make sense of is damage."""
        try:
            with h5py.File(self._path, "r", locking=False) as file:
                yield file.id
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, DamageError):
                raise
            raise self._damage("it isn't an HDF5 file of flat columns") from error

    def _check_names(self, file: h5py.h5f.FileID) -> None:
        """The file holds the columns that are expected, by hard links, and nothing else."""
        names = {name.encode() for name in self._specs}
        self._check_links(h5py.h5g.open(file, b"/"), {n.partition(b"/")[0] for n in names})
        for group in {name.rpartition(b"/")[0] for name in names} - {b""}:
            inside = {n.rpartition(b"/")[2] for n in names if n.startswith(group + b"/")}
            self._check_links(h5py.h5g.open(file, group), inside)

    def _check_links(self, group: h5py.h5g.GroupID, names: set[bytes]) -> None:
        if group.get_num_objs() != len(names):
            raise self._damage(
                f"{group.get_num_objs()} entries beside {b', '.join(sorted(names)).decode()}, "
                f"which are {len(names)}"
            )
        for name in names:
            if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
                raise self._damage(f"{name.decode()} is a link to elsewhere, which is refused")

    def _offset(
        self, column: h5py.h5d.DatasetID, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]
    ) -> int:
        """Where the column begins in the file, once its layout is found to be plain."""
        layout = column.get_create_plist()
        if layout.get_layout() != h5py.h5d.CONTIGUOUS or layout.get_external_count():
            raise self._damage(f"{name} is not stored contiguously in this file")
        if column.shape != shape or column.dtype != dtype:
            raise self._damage(
                f"{name} has shape {column.shape} and type {column.dtype}: {shape} and {dtype} "
                "are expected"
            )
        offset: int | None = column.get_offset()
        if offset is None and 0 not in shape:
            raise self._damage(f"{name} was never written")
        return offset or 0
