"""Files are written whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path

from jbrep.errors import InputError
from jbrep.records.lock import exclusive

_PARTIAL = ".partial"


def read_file(path: Path) -> bytes:
    """The bytes of a file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically: even after a power cut it has all its bytes or is as it was."""
    partial = path.with_name(path.name + _PARTIAL)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:
            file.write(content)
        publish(partial, path)
    except OSError as error:
        reason = f"{error.strerror or error} ({len(content):,} bytes are needed)"
        raise InputError(f"can't write {path}: {reason}") from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_note(path: Path, text: str) -> None:
    """Write a small file that may be lost: whole or not at all, and not where that fails."""
    partial = path.with_name(path.name + _PARTIAL)
    with suppress(OSError):
        partial.write_text(text)
        partial.replace(path)


def write_new(path: Path, content: bytes) -> None:
    """Write a file that doesn't exist yet, as `write_whole`."""
    with unfinished(path) as partial:
        write_whole(partial, content)
        partial.replace(path)
        sync(path.parent)


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """A temporary place beside a new file or folder, for one writer at a time, to `publish`.

    What an earlier writer left there is removed first, what this one leaves at the end.
    """
    with exclusive(path, beside=True):
        partial = path.with_name(f".{path.name}{_PARTIAL}")
        _remove(partial)
        if os.path.lexists(path):
            raise taken(path)
        try:
            yield partial
        finally:
            _remove(partial)


def publish(partial: Path, path: Path) -> None:
    """Bring a file, or a folder with all its files, to the disk, then give it its name.

    Raises:
        OSError: that can't be, as where the name is that of a folder with files.
    """
    for each in (*partial.rglob("*"), partial):
        sync(each)
    partial.replace(path)
    sync(path.parent)


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
    """Make a folder and its parents unless they exist, and see that files can be written there.

    Args:
        folder: to make.
        own: names of what marks a folder as one of those that are to be written, with * for any
            letters; none if it may hold anything.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        there = sorted(each.name for each in folder.iterdir())
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"can't make the folder {folder}: {error.strerror or error}") from error
    # what a killed writer left is nothing yet
    names = [each for each in there if not each.startswith(".") and not each.endswith(_PARTIAL)]
    if own and names and not any(fnmatchcase(name, each) for name in names for each in own):
        raise InputError(
            f"{folder} holds other things, such as {names[0]}: choose a folder that is new or empty"
        )


def check_space(folder: Path, needed: int) -> None:
    """Make sure that enough bytes are free."""
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"not enough space in {folder}: about {needed:,} bytes are needed, {free:,} are free"
        )


def taken(path: Path) -> InputError:
    """The error for a new file or folder whose name is in use."""
    return InputError(f"{path} exists already: choose another name")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
