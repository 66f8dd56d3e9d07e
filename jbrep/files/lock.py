"""A folder with one writer."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import filelock

from jbrep.errors import InputError

_LOCK = ".lock"


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
