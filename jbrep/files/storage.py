"""Files that are there whole or not at all."""

import os
import shutil
import stat
from contextlib import suppress
from pathlib import Path

from jbrep.errors import InputError

_PARTIAL = ".partial"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there with all its bytes, also after a power cut, or not at all.

    Raises:
        InputError: it can't be written; the message names it and the bytes that are needed.
    """
    partial = path.with_name(path.name + _PARTIAL)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:  # never through a link that stands there
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if partial.read_bytes() != content:
            raise OSError("it reads back otherwise")
        partial.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise InputError(
            f"can't write {path}: {error.strerror or error}; {len(content):,} bytes are needed"
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Bring a rename to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def exists(path: str | Path) -> bool:
    """Whether something is there; False, too, where that can't be told, as of a name too long."""
    return os.path.exists(path)  # noqa: PTH110, Path.exists raises there


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, if they aren't there.

    Raises:
        InputError: it can't be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"can't make the folder {folder}: {error.strerror or error}") from None


def check_space(folder: Path, needed: int) -> None:
    """Make sure that so many bytes are free.

    Raises:
        InputError: they aren't.
    """
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"no space in {folder}: about {needed:,} bytes are needed, {free:,} are free"
        )


def regular_size(path: Path) -> int:
    """Bytes of a file; 0 of a link, a pipe or anything else that isn't one."""
    status = path.lstat()
    return status.st_size if stat.S_ISREG(status.st_mode) else 0


def read_regular(path: Path, most: int) -> bytes:
    """A file's bytes; none of something else than a file, or of one that is larger than `most`.

    Raises:
        OSError: it can't be read.
    """
    return path.read_bytes() if 0 < regular_size(path) <= most else b""
