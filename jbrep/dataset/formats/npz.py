"""One npz file: arrays as Gymnasium's users name them, or all columns as jbrep writes them."""

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import (
    Incoming,
    Rows,
    Source,
    check_kind,
    check_lengths,
    check_names,
    label,
)
from jbrep.dataset.formats.flat import CHUNK, PerEpisode, own_names, split
from jbrep.dataset.reader import Dataset
from jbrep.envs.task import Feature
from jbrep.errors import InputError
from jbrep.progress import Progress
from jbrep.records.publish import publish_file, unfinished

Array = NDArray[Any]
_SUFFIX = ".npy"
_DAMAGE = (  # what zipfile and NumPy raise at damaged files, and encrypted ones
    *(ValueError, TypeError, KeyError, OSError, EOFError, RuntimeError),
    *(NotImplementedError, zipfile.BadZipFile, zlib.error),
)
_ONCE = {  # what is known once for each episode
    "final_observation": ("episodes/final_observation", "final_observations"),
    "terminated": ("episodes/terminated",),
    "seed": ("episodes/seed", "seeds"),
}


class _Header(NamedTuple):
    """How an array is stored."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    by_columns: bool  # Fortran's order

    @property
    def rows(self) -> int:
        """How many there are; none of a single number."""
        return self.shape[0] if self.shape else 0


def open_source(given: str) -> Source:
    """Open an npz file; its large arrays are read some rows at a time.

    Raises:
        InputError: it isn't one, or can't be used; nothing in it is unpickled.
    """
    name, path = given, Path(given)
    with _archive(path) as archive:
        headers = {
            member.removesuffix(_SUFFIX): _header(path, archive, member)
            for member in archive.namelist()
            if member.endswith(_SUFFIX)
        }
        own = own_names(name, headers)
        check_names(name, own)
        chosen = {column: headers[own[column]] for column in own}
        check_lengths(name, {column: header.rows for column, header in chosen.items()})
        for column, header in chosen.items():
            check_kind(name, column, header.dtype, header.shape[1:])
        known = _once(path, archive, headers)
        features = _features(path, archive, headers)
    members = {column: f"{own[column]}{_SUFFIX}" for column in own}

    def episodes() -> Iterator[Incoming]:
        return split(name, _chunks(path, members), known)

    rows = headers[own["reward"]].rows
    return Source(name, label(path.stem), episodes, features=features, rows=rows)


def _archive(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except _DAMAGE as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path} can't be read as an npz file: {reason}") from None


def _opened(path: Path, archive: zipfile.ZipFile, member: str) -> IO[bytes]:
    try:
        return archive.open(member)
    except _DAMAGE as error:
        raise InputError(f"{path} is damaged: {member} can't be opened: {error}") from None


def _header(path: Path, archive: zipfile.ZipFile, member: str) -> _Header:
    with _opened(path, archive, member) as file:
        header = _read_header(path, member, file)
        size = archive.getinfo(member).file_size - file.tell()
    if header.dtype.hasobject:
        raise InputError(
            f"{path} has objects in {member.removesuffix(_SUFFIX)}, which would have to be "
            "unpickled, and that can run code: save it as an array of plain numbers"
        )
    if int(np.prod(header.shape, dtype=object)) * header.dtype.itemsize != size:
        raise _cut_short(path, member)
    return header


def _read_header(path: Path, member: str, file: IO[bytes]) -> _Header:
    try:
        version = np.lib.format.read_magic(file)
        read = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, by_columns, dtype = read(file)
    except _DAMAGE:
        raise InputError(f"{path} has no array in {member}: it must be a NumPy file") from None
    return _Header(shape, dtype, by_columns and len(shape) > 1)


def _cut_short(path: Path, member: str) -> InputError:
    name = member.removesuffix(_SUFFIX)
    return InputError(f"{path} is damaged: {name} has other bytes than its shape and type say")


def _chunks(path: Path, members: dict[str, str]) -> Iterator[Rows]:
    """The columns, some rows at a time."""
    with ExitStack() as stack:
        archive = stack.enter_context(_archive(path))
        streams = {
            name: _stream(path, member, stack.enter_context(_opened(path, archive, member)))
            for name, member in members.items()
        }
        for chunk in zip(*streams.values(), strict=True):
            yield dict(zip(streams, chunk, strict=True))


def _stream(path: Path, member: str, file: IO[bytes]) -> Iterator[Array]:
    """An array's rows in chunks; read at once if it is stored by columns."""
    header = _read_header(path, member, file)
    count, *row = header.shape
    width = int(np.prod(row, dtype=object))
    whole = None
    if header.by_columns:
        content = _read(path, member, file, count * width * header.dtype.itemsize)
        whole = np.frombuffer(content, header.dtype).reshape(header.shape, order="F")
    for start in range(0, count, CHUNK):
        rows = min(CHUNK, count - start)
        if whole is None:
            content = _read(path, member, file, rows * width * header.dtype.itemsize)
            chunk = np.frombuffer(content, header.dtype).reshape(rows, *row)
        else:
            chunk = whole[start : start + rows]
        yield chunk


def _read(path: Path, member: str, file: IO[bytes], size: int) -> bytes:
    try:
        content = file.read(size)
    except _DAMAGE:
        raise _cut_short(path, member) from None
    if len(content) != size:
        raise _cut_short(path, member)
    return content


def _once(path: Path, archive: zipfile.ZipFile, headers: dict[str, _Header]) -> PerEpisode:
    """What is known once for each episode."""
    arrays: dict[str, Array] = {}
    for column, aliases in _ONCE.items():
        for alias in aliases:
            if alias in headers:
                arrays[column] = _whole(path, archive, alias)
    return PerEpisode.of(str(path), arrays)


def _features(
    path: Path, archive: zipfile.ZipFile, headers: dict[str, _Header]
) -> tuple[Feature, ...]:
    """Names and units, if there are any."""
    if "feature_names" not in headers:
        return ()
    names = [str(name) for name in _whole(path, archive, "feature_names").ravel()]
    units = [""] * len(names)
    if "feature_units" in headers:
        units = [str(unit) for unit in _whole(path, archive, "feature_units").ravel()]
    if len(units) != len(names):
        raise InputError(f"{path} has {len(names)} feature names and {len(units)} units")
    return tuple(Feature(name, unit) for name, unit in zip(names, units, strict=True))


def _whole(path: Path, archive: zipfile.ZipFile, name: str) -> Array:
    with _opened(path, archive, f"{name}{_SUFFIX}") as file:
        try:
            return np.lib.format.read_array(file, allow_pickle=False)
        except _DAMAGE:
            raise _cut_short(path, name) from None


def write(dataset: Dataset, out: Path) -> str:
    """Stream the columns to an uncompressed zip; returns how to open it."""
    with unfinished(out) as partial:
        _write_zip(dataset, partial, out.name)
        publish_file(partial, out)
    return f"numpy.load({str(out)!r})"


def _write_zip(dataset: Dataset, path: Path, name: str) -> None:
    arrays = {f"episodes/{name}": values for name, values in dataset.episodes.items()}
    arrays["feature_names"] = np.array(dataset.task.feature_names)
    arrays["feature_units"] = np.array([feature.unit for feature in dataset.task.features])
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for column_name in Progress(dataset.columns, unit="column", desc=name):
            column = dataset[column_name]
            with archive.open(f"{column_name}.npy", "w", force_zip64=True) as file:
                header = {"descr": column.dtype.str, "fortran_order": False, "shape": column.shape}
                np.lib.format.write_array_header_1_0(file, header)
                for chunk in column.chunks():
                    file.write(np.ascontiguousarray(chunk).data)
        for array_name, values in arrays.items():
            with archive.open(f"{array_name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
