"""One npz file: arrays as Gymnasium's users name them, or all columns as jbrep writes them."""

import hashlib
import io
import math
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import Rows, Source, check_arrays, check_names, label
from jbrep.dataset.formats.flat import CHUNK, own_names, per_episode, split
from jbrep.dataset.reader import Dataset
from jbrep.envs.task import Feature
from jbrep.errors import DamageError, InputError, refusing
from jbrep.progress import Progress
from jbrep.records.storage import publish, unfinished
from jbrep.text import words

Array = NDArray[Any]
EPISODE_BYTES = 0  # besides its rows
_SUFFIX = ".npy"
_MOST_HEADER = 10_000  # bytes, which is NumPy's own limit
_MOST_AT_ONCE = 1 << 30  # bytes of an array, which zeros can be squeezed into a thousandth of
_MOST_WORDS = 1 << 22  # likewise, of names
_DAMAGE = (  # what zipfile and NumPy raise at damaged files, and encrypted ones
    *(ValueError, TypeError, KeyError, OSError, EOFError, RuntimeError),
    *(NotImplementedError, zipfile.BadZipFile, zlib.error),
)
_SHA256 = "sha256"  # of what jbrep writes: the name and the SHA-256 of each other member, (n, 2)
_EPISODES = "episodes/"  # which only jbrep writes, too
_OFFSETS = "feature_offsets"  # which only jbrep writes: subtracted from observations, (d,)
_ONCE = {  # what is known once for each episode
    "final_observation": ("episodes/final_observation", "final_observations"),
    "terminated": ("episodes/terminated",),
    "truncated": ("episodes/truncated",),
    "seed": ("episodes/seed", "seeds"),
}


class _Stored(NamedTuple):
    """An array as it is stored, opened where its values begin."""

    file: IO[bytes]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    order: Literal["C", "F"]  # F where it is stored by columns

    def read(self, *shape: int) -> Array:
        """The next values, as many as make an array of that shape."""
        count = math.prod(shape)
        content = self.file.read(count * self.dtype.itemsize)
        return np.frombuffer(content, self.dtype, count).reshape(shape, order=self.order)


@contextmanager
def _opened(archive: zipfile.ZipFile, name: str) -> Iterator[_Stored]:
    """An array of the archive."""
    try:
        with archive.open(f"{name}{_SUFFIX}") as file:
            width, read = {
                (1, 0): (2, np.lib.format.read_array_header_1_0),
                (2, 0): (4, np.lib.format.read_array_header_2_0),
            }[np.lib.format.read_magic(file)]
            begins = file.read(width)
            length = int.from_bytes(begins, "little")
            if length > _MOST_HEADER:  # NumPy would read it before
                raise ValueError
            shape, by_columns, dtype = read(io.BytesIO(begins + file.read(length)))
            if dtype.hasobject:
                raise InputError(
                    f"{archive.filename} has objects in {name}, which would have to be unpickled, "
                    "and that can run code: save it as an array of plain numbers"
                )
            size = archive.getinfo(f"{name}{_SUFFIX}").file_size - file.tell()
            if math.prod(shape) * dtype.itemsize != size:
                raise ValueError
            yield _Stored(file, shape, dtype, "F" if by_columns else "C")
    except InputError:
        raise
    except _DAMAGE:
        raise InputError(
            f"{archive.filename} is damaged: {name} isn't an array, or has other bytes than its "
            "shape and type say"
        ) from None


def open_source(given: str) -> Source:
    """Open an npz file; its large arrays are read some rows at a time.

    Raises:
        DamageError: it isn't what jbrep exported.
    """
    path, stored = Path(given), dict[str, _Stored]()
    with _archive(path) as archive:
        for member in archive.namelist():
            if not member.endswith(_SUFFIX):
                raise InputError(f"{path} has {member!r}, which must be an array: *{_SUFFIX}")
            name = member.removesuffix(_SUFFIX)
            with _opened(archive, name) as stored[name]:
                pass
        _check_exported(archive, stored)
        own = own_names(given, stored)
        check_names(given, own)
        check_arrays(given, {column: stored[name] for column, name in own.items()})
        known = per_episode(given, _once(archive, stored))
        features = _features(archive, stored)
        offsets = _offsets(archive, stored, own["observation"])
    return Source(
        given,
        label(path.stem),
        lambda: split(given, _chunks(path, own), known),
        features=features,
        rows=math.prod(stored[own["action"]].shape[:1]),
        has_rewards="reward" in own,
        subtracted=offsets,
    )


def _check_exported(archive: zipfile.ZipFile, names: Collection[str]) -> None:
    """Make sure that what jbrep exported is what it was; a zip file's names have no checksum.

    Raises:
        DamageError: it isn't.
    """
    if _SHA256 not in names and not any(name.startswith(_EPISODES) for name in names):
        return
    known = _whole(archive, _SHA256, _MOST_WORDS).tolist() if _SHA256 in names else []
    if known != _sha256(archive):
        raise DamageError(
            f"{archive.filename} is damaged: it isn't what was exported, by its checksums; export "
            "the data set again"
        )


def _sha256(archive: zipfile.ZipFile) -> list[list[str]]:
    """The name and the SHA-256 of each member, in the order of names.

    Raises:
        DamageError: one can't be read.
    """
    sums = list[list[str]]()
    for member in sorted({*archive.namelist()} - {f"{_SHA256}{_SUFFIX}"}):
        told = f"{archive.filename} is damaged: {member} can't be read"
        with refusing(told, _DAMAGE, kind=DamageError), archive.open(member) as file:
            digest = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]  # of IO[bytes]
            sums.append([member, digest.hexdigest()])
    return sums


def _archive(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except _DAMAGE as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path} can't be read as an npz file: {reason}") from None


def _chunks(path: Path, own: dict[str, str]) -> Iterator[Rows]:
    """The columns, some rows at a time."""
    with _archive(path) as archive:
        streams = [_stream(archive, name) for name in own.values()]
        for chunk in zip(*streams, strict=True):
            yield dict(zip(own, chunk, strict=True))


def _stream(archive: zipfile.ZipFile, name: str) -> Iterator[Array]:
    """An array's rows in chunks; read at once if it is stored by columns."""
    with _opened(archive, name) as stored:
        if stored.order == "F":
            _check_size(archive, name, stored, _MOST_AT_ONCE)
        count, *row = stored.shape
        most = CHUNK if stored.order == "C" else max(1, count)
        for start in range(0, count, most):
            values = stored.read(min(most, count - start), *row)
            for first in range(0, len(values), CHUNK):
                yield values[first : first + CHUNK]


def _whole(archive: zipfile.ZipFile, name: str, most: int = _MOST_AT_ONCE) -> Array:
    with _opened(archive, name) as stored:
        _check_size(archive, name, stored, most)
        return stored.read(*stored.shape)


def _check_size(archive: zipfile.ZipFile, name: str, stored: _Stored, most: int) -> None:
    """Refuse an array that is read at once, but too large for that."""
    size = math.prod(stored.shape) * stored.dtype.itemsize
    if size > most:
        raise InputError(
            f"{archive.filename} has {size:,} bytes in {name}, which must be read at once: at most "
            f"{most:,} can be; observations and the like are read in parts if stored by rows"
        )


def _once(archive: zipfile.ZipFile, names: Collection[str]) -> dict[str, Array]:
    """What is known once for each episode."""
    return {
        column: _whole(archive, alias)
        for column, aliases in _ONCE.items()
        for alias in aliases
        if alias in names
    }


def _offsets(archive: zipfile.ZipFile, stored: Mapping[str, _Stored], observation: str) -> Array:
    """What observations lack already; (d,) zeros if nothing is said."""
    size = math.prod(stored[observation].shape[1:])
    if _OFFSETS not in stored:
        return np.zeros(size)
    offsets = _whole(archive, _OFFSETS)
    if offsets.shape != (size,) or offsets.dtype.kind != "f" or not np.isfinite(offsets).all():
        raise InputError(f"{archive.filename}: {_OFFSETS} must be {size} numbers, of each feature")
    return offsets.astype(np.float64)


def _features(archive: zipfile.ZipFile, names: Collection[str]) -> tuple[Feature, ...]:
    """Names and units, if there are any."""
    given, units = (
        [str(word) for word in _whole(archive, name, _MOST_WORDS).ravel()] if name in names else []
        for name in ("feature_names", "feature_units")
    )
    if units and len(units) != len(given):
        has = f"{len(given)} feature names and {len(units)} units"
        raise InputError(f"{archive.filename} has {has}")
    features = list[Feature]()
    for name, unit in zip(words(given), units or [""] * len(given), strict=True):
        try:
            features.append(Feature(name, unit))
        except InputError as error:
            raise InputError(f"{archive.filename}, feature {name}: {error}") from None
    return tuple(features)


def write(dataset: Dataset, out: Path) -> str:
    """Stream the columns to an uncompressed zip; returns how to open it."""
    with unfinished(out) as partial:
        _write_zip(dataset, partial, out.name)
        publish(partial, out)
    return f"numpy.load({str(out)!r})"


def _write_zip(dataset: Dataset, path: Path, name: str) -> None:
    arrays = {f"{_EPISODES}{name}": values for name, values in dataset.episodes.items()}
    arrays["feature_names"] = np.array(dataset.task.feature_names)
    arrays["feature_units"] = np.array([feature.unit for feature in dataset.task.features])
    arrays[_OFFSETS] = dataset.task.offset
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for array_name, values in arrays.items():  # first: they say that there are checksums
            _write_array(archive, array_name, values)
        for column_name in Progress(dataset.columns, unit="column", desc=name):
            column = dataset[column_name]
            with archive.open(f"{column_name}{_SUFFIX}", "w", force_zip64=True) as file:
                header = {"descr": column.dtype.str, "fortran_order": False, "shape": column.shape}
                np.lib.format.write_array_header_1_0(file, header)
                for chunk in column.chunks():
                    file.write(np.ascontiguousarray(chunk).data)
        _write_array(archive, _SHA256, np.array(_sha256(archive)))


def _write_array(archive: zipfile.ZipFile, name: str, values: Array) -> None:
    with archive.open(f"{name}{_SUFFIX}", "w", force_zip64=True) as file:
        np.lib.format.write_array(file, values, allow_pickle=False)
