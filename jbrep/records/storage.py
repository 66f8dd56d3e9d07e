"""Reading and writing files safely: whole or not at all, regular, of bounded size."""

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from io import BufferedReader
from pathlib import Path

from jbrep.errors import InputError
from jbrep.records.lock import exclusive

_PARTIAL = ".partial"
_AT_A_TIME = 1 << 20  # bytes
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK  # neither a link nor a pipe that nobody fills


class MissingFileError(InputError):
    """There is no file at a path."""


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically: even after a power cut it has all its bytes or doesn't exist."""
    partial = path.with_name(path.name + _PARTIAL)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:  # never through a link of that name
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if not _holds(partial, content):
            raise OSError("it reads back otherwise")
        partial.replace(path)
        sync(path.parent)
    except OSError as error:
        raise InputError(
            f"can't write {path}: {error.strerror or error} ({len(content):,} bytes are needed)"
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _holds(path: Path, content: bytes) -> bool:
    """Whether a file has that content, read some bytes at a time: it may take half of memory."""
    parts, size = memoryview(content), path.stat().st_size
    with path.open("rb") as file:
        begins = range(0, len(parts), _AT_A_TIME)
        return size == len(parts) and all(
            file.read(_AT_A_TIME) == parts[i : i + _AT_A_TIME] for i in begins
        )


def write_note(path: Path, text: str) -> None:
    """Write a small file that may be lost: whole or not at all, never through a link, not synced.

    It isn't written where that fails, as on a full disk.
    """
    partial = path.with_name(path.name + _PARTIAL)
    with suppress(OSError):
        partial.unlink(missing_ok=True)
        with partial.open("x") as file:
            file.write(text)
        partial.replace(path)


def write_new(path: Path, content: bytes) -> None:
    """Write a file that doesn't exist yet, as `write_whole`."""
    with unfinished(path) as partial:
        write_whole(partial, content)
        try:
            publish_file(partial, path)
        except OSError as error:
            raise InputError(f"can't write {path}: {error.strerror or error}") from error


def inside(folder: Path, *parts: str) -> Path:
    """The path of what is in a folder of jbrep's own, such as a study's.

    The folder's path is its user's and may lead through links. What is in it may come from a
    stranger, and links there could lead to any file of the user's.

    Args:
        folder: that is jbrep's own.
        parts: names below it, or several at once, as in "runs/full".
    """
    path = folder
    for name in Path(*parts).parts:
        if name == ".." or Path(name).is_absolute():
            raise InputError(f"{Path(*parts)} leads out of {folder}")
        path = path / name
        if path.is_symlink():
            raise InputError(
                f"{path} is a link, which isn't followed there: put what it leads to in its place"
            )
    return path


def sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def exists(path: str | Path) -> bool:
    """Whether the path exists; False where the system can't tell, as for a name too long."""
    return os.path.exists(path)  # noqa: PTH110, Path.exists raises there


def make_folder(folder: Path, own: Collection[str] = ()) -> None:
    """Make a folder and its parents unless they exist.

    Args:
        folder: to make.
        own: names of what marks a folder as one of those that are to be written, with * for any
            letters; none if it may hold anything.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        there = sorted(each.name for each in folder.iterdir())
    except OSError as error:
        raise InputError(f"can't make the folder {folder}: {error.strerror or error}") from None
    # what a killed writer left is nothing yet
    names = [each for each in there if not each.startswith(".") and not each.endswith(_PARTIAL)]
    if own and names and not any(fnmatchcase(name, each) for name in names for each in own):
        raise InputError(
            f"{folder} holds other things, such as {names[0]}: choose a folder that is new or empty"
        )


def check_writable(folder: Path, own: Collection[str] = ()) -> None:
    """Make a folder unless it exists, and see that files can be written into it."""
    make_folder(folder, own)
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"can't write into {folder}: {error.strerror or error}") from None


def check_space(folder: Path, needed: int) -> None:
    """Make sure that enough bytes are free."""
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise _no_space(folder, needed, f"{free:,} are free")


def check_allocation(folder: Path, needed: int) -> None:
    """The same by a file of that size, as a quota or a limit of files would stop it, too."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, needed)
    except OSError as error:
        raise _no_space(folder, needed, (error.strerror or str(error)).lower()) from None


def _no_space(folder: Path, needed: int, why: str) -> InputError:
    return InputError(f"not enough space in {folder}: about {needed:,} bytes are needed, {why}")


def open_regular(path: Path) -> BufferedReader | None:
    """Open a regular file; None of a link, a pipe or anything else.

    Raises:
        OSError: it can't be opened, or there is none.
    """
    try:
        descriptor = os.open(path, _READ)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):  # a link, a socket
            return None
        raise
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    return None


def read_regular(path: Path, most: int) -> bytes:
    """The bytes of a regular file of at most `most` bytes; of anything else, none.

    Raises:
        MissingFileError: there is none.
    """
    try:
        file = open_regular(path)
        if file is None:
            return b""
        with file:
            return file.read() if os.fstat(file.fileno()).st_size <= most else b""
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        kind = MissingFileError if is_missing else InputError
        raise kind(f"can't read {path}: {error.strerror or error}") from error
    except ValueError:  # a NUL character
        raise InputError(f"can't read {str(path)!r}: no path has such a character") from None


def read_file(path: Path, most: int) -> bytes:
    """The same of 1 to `most` bytes."""
    content = read_regular(path, most)
    if not content:
        raise InputError(f"{path} must be a regular file of 1 to {most:,} bytes")
    return content


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """A temporary place beside a new file or folder, for one writer at a time.

    What an earlier writer left there is removed first, what this one leaves at the end.
    """
    with exclusive(path, beside=True):
        partial = path.with_name(f".{path.name}.partial")
        _remove(partial)
        if os.path.lexists(path):
            raise taken(path)
        try:
            yield partial
        finally:
            _remove(partial)


def publish_file(partial: Path, path: Path) -> None:
    """Bring a file to the disk, then give it its name."""
    sync(partial)
    try:
        os.link(partial, path)  # unlike a rename, it never replaces a file
    except FileExistsError:
        raise taken(path) from None
    except OSError:  # no hard links on this file system
        path.touch(exist_ok=False)
        partial.replace(path)
    try:
        sync(path.parent)
    except BaseException:
        path.unlink()
        raise


def publish_folder(partial: Path, path: Path) -> None:
    """Bring a folder with all its files to the disk, then give it its name.

    Raises:
        OSError: the name has been taken meanwhile.
    """
    for folder, _, files in os.walk(partial):
        for name in files:
            sync(Path(folder, name))
        sync(Path(folder))
    partial.rename(path)  # it replaces an empty folder, and nothing else
    try:
        sync(path.parent)
    except BaseException:
        path.rename(partial)
        raise


def taken(path: Path) -> InputError:
    """The error for a new file or folder whose name is in use."""
    return InputError(f"{path} exists already: choose another name")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
