"""Files are written whole or not at all, by one writer at a time."""

import os
import shutil
import socket
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from fnmatch import fnmatchcase
from pathlib import Path

import filelock

from jbrep.errors import InputError

_PARTIAL = ".partial"


def read_file(path: Path) -> bytes:
    """The bytes of a file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error


def write_whole(path: Path, content: bytes, ready: Callable[[], object] = lambda: None) -> None:
    """Write a file atomically: even after a power cut it has all its bytes or is as it was.

    `ready` is called when they are on the disk, before they take the place of others.
    """
    partial = path.with_name(path.name + _PARTIAL)
    try:
        partial.unlink(missing_ok=True)
        with partial.open("xb") as file:
            file.write(content)
        sync(partial)
        ready()
        partial.replace(path)
        sync(path.parent)
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
        publish(partial, path)


@contextmanager
def exclusive(path: Path, *, beside: bool = False, wait: float = 0) -> Iterator[None]:
    """Be the only writer in a folder, which has a file `.lock` until the process ends or lets go.

    With `beside`, the lock stands beside the path, which may not exist yet. Another process is
    waited for, up to `wait` seconds.
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
    """Bring a file, or a folder with all its files, to the disk, then give it its name."""
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

    One that holds other things is refused, unless some have the names of its `own`, patterns.
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
    """Make sure that so many bytes are free."""
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
