"""One shard: an HDF5 file of flat columns, made in memory and read as memory maps."""

import hashlib
import math
import mmap
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray

from jbrep.dataset.schema import Columns, Spec
from jbrep.errors import InputError

MEND = "jbrep data repair makes it again"
_HASH = "sha256"  # attribute of every column


class DamageError(InputError):
    """A file of a data set is not what was committed; the message names it."""


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
    """
    try:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode) or not status.st_size:
            raise DamageError(f"{path} is damaged: a regular file that isn't empty is expected")
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError:
        raise DamageError(f"{path} is missing: {MEND}") from None


def stored_attributes(path: Path) -> dict[str, Any]:
    """What a shard says of itself: whole numbers, texts and lists of texts.

    Raises:
        DamageError: it can't be read.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            return {name: _plain(value) for name, value in file.attrs.items()}
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise DamageError(f"{path} is damaged: its attributes can't be read") from error


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def stored_hashes(path: Path, names: Iterable[str]) -> dict[str, str]:
    """The hashes that the columns of a shard carry.

    Raises:
        DamageError: they can't be read.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            return {name: str(file[name].attrs[_HASH]) for name in names}
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise DamageError(f"{path} is damaged: its hashes can't be read") from error


def map_columns(
    path: Path, content: mmap.mmap, specs: Mapping[str, Spec], rows: Mapping[str, int]
) -> dict[str, NDArray[Any]]:
    """The columns of a shard as read-only views of its bytes.

    Nothing but contiguous data inside this very file is accepted, so HDF5 is never asked to read
    any: no link, external file, virtual data set or filter is followed.

    Args:
        path: of the shard, for the messages and for HDF5's structure.
        content: its bytes.
        specs: the columns that are expected, no more and no fewer.
        rows: how many rows each has.

    Raises:
        DamageError: the file's structure is another.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            _check_names(path, file, specs)
            offsets = {
                name: _offset(path, file[name], name, spec, rows[name])
                for name, spec in specs.items()
            }
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, DamageError):
            raise
        raise DamageError(f"{path} is damaged: not an HDF5 file of flat columns") from error
    views = {}
    for name, spec in specs.items():
        shape = spec.shape(rows[name])
        count = math.prod(shape)
        if offsets[name] + count * spec.dtype.itemsize > len(content):
            raise DamageError(f"{path} is damaged: {name} goes beyond its end")
        views[name] = np.frombuffer(content, spec.dtype, count, offsets[name]).reshape(shape)
    return views


def _check_names(path: Path, file: h5py.File, specs: Mapping[str, Spec]) -> None:
    """Every link on the way to a column is a hard one, and there is nothing else."""
    groups = {name.rpartition("/")[0] for name in specs} - {""}
    expected = {name.partition("/")[0] for name in specs}
    for group in ("", *sorted(groups)):
        here = file[group or "/"]
        names = expected if not group else {n.split("/")[1] for n in specs if n.startswith(group)}
        if len(here) != len(names):
            raise DamageError(
                f"{path} holds {len(here)} entries in {group or 'its root'}: "
                f"{', '.join(sorted(names))} are expected"
            )
        for name in names:
            if not isinstance(here.get(name, getlink=True), h5py.HardLink):
                raise DamageError(f"{path}: {name} is a link out of its place, which is refused")


def _offset(path: Path, dataset: Any, name: str, spec: Spec, rows: int) -> int:
    """Where the column begins in the file, once its layout is found to be plain."""
    if not isinstance(dataset, h5py.Dataset):
        raise DamageError(f"{path}: {name} is not a data set")
    layout = dataset.id.get_create_plist()
    if layout.get_layout() != h5py.h5d.CONTIGUOUS or layout.get_external_count():
        raise DamageError(f"{path}: {name} is not stored contiguously in this file")
    if dataset.shape != spec.shape(rows) or dataset.dtype != spec.dtype:
        raise DamageError(
            f"{path}: {name} has shape {dataset.shape} and type {dataset.dtype}: "
            f"{spec.shape(rows)} and {spec.dtype} are expected"
        )
    offset: int | None = dataset.id.get_offset()
    if offset is None and rows:
        raise DamageError(f"{path}: {name} was never written")
    return offset or 0
