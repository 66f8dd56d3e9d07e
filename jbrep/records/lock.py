"""Locks: a folder or a file with one writer at a time."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import filelock

from jbrep.errors import InputError


@contextmanager
def exclusive(path: Path, *, beside: bool = False, wait: float = 0) -> Iterator[None]:
    """Be the only writer in a folder, which has a file `.lock` until the process ends or lets go.

    Args:
        path: the folder; with `beside`, a file or folder that may not exist yet.
        beside: whether the lock stands beside the path instead.
        wait: for another process, so many seconds at most.
    """
    if beside and not path.name:
        raise InputError(f"{path} can't be a new file or folder: give it a name")
    note = path.with_name(f".{path.name}.lock") if beside else path / ".lock"
    lock, holder = filelock.FileLock(note), ""
    try:
        lock.acquire(timeout=wait)
        now = datetime.now().astimezone().isoformat(" ", "seconds")
        note.write_text(f"process {os.getpid()} on {socket.gethostname()} since {now}")
    except filelock.Timeout:
        with suppress(OSError):  # released and removed meanwhile
            holder = note.read_text()
        who = holder or "another process"
        raise InputError(f"{path} is being written by {who}: wait for it or stop it") from None
    except OSError as error:
        lock.release()
        raise InputError(f"can't write in {note.parent}: {error.strerror or error}") from error
    try:
        yield
    finally:
        note.unlink(missing_ok=True)  # filelock notices that a lock it gets was removed
        lock.release()
