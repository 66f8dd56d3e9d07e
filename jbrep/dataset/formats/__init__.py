"""Data sets in other tools' formats: exported to them, and imported from them or from logs.

What reads a format is a module with `read(path)`, which returns a `Frame`; `Source` makes episodes
of it, and `writer.write` a data set of these.
"""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from jbrep.dataset.layout import Layout
from jbrep.dataset.manifest import MANIFEST
from jbrep.errors import InputError, choose, listed, refusing
from jbrep.records.storage import exists

if TYPE_CHECKING:
    from jbrep.dataset.formats.source import Source
    from jbrep.dataset.reader import Dataset

FORMATS = {name: f"{__name__}.{name}" for name in ("minari", "parquet", "npz", "lerobot")}
_FILES = {  # which module reads files that end so
    **{"npz": "npz", "parquet": "parquet"},
    **dict.fromkeys(("csv", "tsv", "txt"), "delimited"),
    **dict.fromkeys(("bag", "mcap", "db3"), "bags"),
    **dict.fromkeys(("hdf5", "h5"), "hdf5"),
}
_FOLDERS = {"meta/info.json": "lerobot", "metadata.yaml": "bags"}  # that hold such a file


def export(dataset: "Dataset", to: str, out: Path) -> str:
    """Write a data set in another format; returns how to open it.

    Args:
        dataset: what to write.
        to: a key of `FORMATS`.
        out: a new file, which ends as its format does, or a folder; for Minari a folder of Minari
            data sets, new or not.
    """
    module = import_module(choose(to, FORMATS, "format"))
    if out.name and to in _FILES and out.suffix.lower() != f".{to}":
        raise InputError(f"{out} must end in .{to}, by which jbrep data import knows the format")
    if not len(dataset):
        raise InputError(f"{dataset.folder} has no rows yet")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        how: str = module.write(dataset, out)
    except (OSError, RuntimeError) as error:  # HDF5 raises the latter when the disk is full
        reason = getattr(error, "strerror", None) or error  # some have only a text
        raise InputError(f"can't write {out}: {reason}") from error
    return how


def open_sources(given: Sequence[str], layout: Layout | None = None, missing: str = "") -> "Source":
    """Open files and folders that are to be imported together, or a Minari data set by its id."""
    from jbrep.dataset.formats.source import Source

    readers = [load_reader(each) for each in given]
    with refusing(f"{listed(given)} can't be imported"):
        paths = [Path(each).resolve() for each in given]
        once = zip(given, paths, strict=True)
        if twice := [each for each, path in once if paths.count(path) > 1]:
            raise InputError(f"{twice[-1]} is given twice: leave one out")
        before = _states(paths)
        read = (reader.read(each) for reader, each in zip(readers, given, strict=True))
        first, *others = [Source(frame, layout, missing) for frame in read]
        first.join(*others)
    first.has_changed = lambda: _states(paths) != before
    return first


def _states(paths: Sequence[Path]) -> list[tuple[Path, int, int]]:
    """Files, their sizes and when they were changed."""
    files = (each for path in paths for each in [path, *sorted(path.rglob("*"))] if each.exists())
    states = ((each, each.stat()) for each in files)
    return [(each, state.st_size, state.st_mtime_ns) for each, state in states]


def load_reader(given: str) -> ModuleType:
    """Import what reads a file or folder; ModuleNotFoundError tells what isn't installed."""
    path = Path(given)
    suffix = path.suffix.removeprefix(".").lower()
    is_file = exists(path) and not path.is_dir()
    if is_file and not path.is_file():
        raise InputError(f"{path} is a pipe or a device: it must be a regular file")
    if is_file and suffix not in _FILES:
        raise InputError(f"unknown format '.{suffix}': choose one of {', '.join(_FILES)}")
    if exists(path / MANIFEST):
        raise InputError(f"{path} is already a jbrep data set: there is nothing to import")
    if not exists(path) and suffix in _FILES:
        raise InputError(f"there is no file {path}")
    bags = [each.name for each in sorted(path.glob("*")) if each.suffix in (".mcap", ".db3")]
    if bags and not exists(path / "metadata.yaml"):
        raise InputError(f"{path} has no metadata.yaml: give its files themselves, {listed(bags)}")
    folders = (name for mark, name in _FOLDERS.items() if exists(path / mark))
    return import_module(f"{__name__}.{_FILES[suffix] if is_file else next(folders, 'minari')}")
