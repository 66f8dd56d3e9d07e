"""Locks: a folder or a file with one writer at a time."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import filelock

from jbrep.errors import InputError


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Be the only writer in a folder, which has a file `.lock` for as long.

    The lock is released when its process ends, even where that was killed and left the file.

    Raises:
        InputError: another process is writing there; the message names it.
    """
    with _hold(folder / ".lock", folder):
        yield


@contextmanager
def exclusive_file(path: Path) -> Iterator[None]:
    """Be the only writer of a file or folder that may not exist yet; the lock stands beside it.

    Raises:
        InputError: another process is writing it; the message names it.
    """
    lock = path.with_name(f".{path.name}.lock")
    with _hold(lock, path):
        yield


@contextmanager
def _hold(path: Path, locked: Path) -> Iterator[None]:
    lock = filelock.FileLock(path)
    now = datetime.now().astimezone().isoformat(" ", "seconds")
    try:
        lock.acquire(blocking=False)
        path.write_text(f"process {os.getpid()} on {socket.gethostname()} since {now}")
    except filelock.Timeout:
        raise InputError(
            f"{locked} is being written by {_holder(path)}: wait for it or stop it"
        ) from None
    except OSError as error:
        lock.release()
        raise InputError(f"can't write in {path.parent}: {error.strerror or error}") from error
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # filelock notices that a lock it gets was removed
        lock.release()


def _holder(path: Path) -> str:
    try:
        return path.read_text() or "another process"
    except OSError:  # released and removed meanwhile
        return "another process"
