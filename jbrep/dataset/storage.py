"""Files that are there whole or not at all, and a folder with one writer."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import filelock

from jbrep.errors import InputError

_LOCK = ".lock"
_PARTIAL = ".partial"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there with all its bytes, also after a power cut, or not at all.

    Raises:
        InputError: it can't be written; the message names it and the bytes that are needed.
    """
    partial = path.with_name(path.name + _PARTIAL)
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if partial.read_bytes() != content:
            raise OSError("it reads back otherwise")
        partial.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(
            f"can't write {path}: {error.strerror or error}; {len(content):,} bytes are needed"
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Bring a rename to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Be the only one to write to the folder; the lock goes with the process that holds it.

    Raises:
        InputError: another process writes there; the message names it.
    """
    path = folder / _LOCK
    lock = filelock.FileLock(path)
    now = datetime.now().astimezone().isoformat(" ", "seconds")
    try:
        lock.acquire(blocking=False)
        path.write_text(f"process {os.getpid()} on {socket.gethostname()} since {now}")
    except filelock.Timeout:
        holder = path.read_text() or "another process"
        raise InputError(f"{folder} is being written by {holder}: wait for it or stop it") from None
    except OSError as error:
        lock.release()
        raise InputError(f"can't write in {folder}: {error.strerror or error}") from error
    try:
        yield
    finally:
        lock.release()
