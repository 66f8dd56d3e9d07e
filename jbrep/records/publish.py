"""New files and folders that get their names when they are finished."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jbrep.errors import InputError
from jbrep.records.lock import exclusive
from jbrep.records.storage import sync


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """A temporary place beside a new file or folder, for one writer at a time.

    What an earlier writer left there is removed first, what this one leaves at the end.

    Raises:
        InputError: the path exists already, or another process is writing it.
    """
    with exclusive(path, beside=True):
        if os.path.lexists(path):
            raise _taken(path)
        partial = path.with_name(f".{path.name}.partial")
        _remove(partial)
        try:
            yield partial
        finally:
            _remove(partial)


def publish_file(partial: Path, path: Path) -> None:
    """Bring a file to the disk, then give it its name.

    Raises:
        InputError: the name has been taken meanwhile.
    """
    sync(partial)
    try:
        os.link(partial, path)  # unlike a rename, it never replaces a file
    except FileExistsError:
        raise _taken(path) from None
    except OSError:  # no hard links on this file system
        path.touch(exist_ok=False)
        partial.replace(path)
    sync(path.parent)


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
    sync(path.parent)


def _taken(path: Path) -> InputError:
    return InputError(f"{path} exists already: choose another name")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
