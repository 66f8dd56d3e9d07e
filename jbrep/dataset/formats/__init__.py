"""Data sets in other tools' formats: exported to them, and imported from them or from logs."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from jbrep.dataset.formats.episodes import CLOCKS, Source
from jbrep.dataset.layout import Layout
from jbrep.dataset.manifest import MANIFEST
from jbrep.errors import InputError, choose
from jbrep.records.storage import check_space, exists
from jbrep.text import counted

if TYPE_CHECKING:
    from jbrep.dataset.reader import Dataset

_FILE_BYTES = 1 << 16  # whatever is in it
FORMATS = {
    name: f"{__name__}.{name}" for name in ("minari", "parquet", "npz", "lerobot")
}  # modules
_FILES = {  # which module reads files that end so
    **{"npz": "npz", "parquet": "parquet"},
    **dict.fromkeys(("csv", "tsv", "txt"), "delimited"),
    **dict.fromkeys(("bag", "mcap", "db3"), "bags"),
    **dict.fromkeys(("hdf5", "h5"), "hdf5"),
}
_FOLDERS = {
    "meta/info.json": "lerobot",
    "metadata.yaml": "bags",
}  # that a folder holds
_ALIKE = {  # what data that are imported together have in common
    "task": "is of another task than",
    "features": "has other features than",
    "has_rewards": "has rewards, or none, unlike",
    "action_bounds": "has other bounds of actions than",
    "subtracted": "has other offsets of features subtracted than",
}


def load_format(name: str) -> ModuleType:
    """Import what reads and writes a format.

    Raises:
        ModuleNotFoundError: it needs a package that isn't installed.
    """
    return import_module(choose(name, FORMATS, "format"))


def export(dataset: "Dataset", to: str, out: Path) -> str:
    """Write a data set in another format.

    Args:
        dataset: what to write.
        to: a key of `FORMATS`.
        out: a new file, which ends as its format does, or a folder; for Minari a folder of Minari
            data sets, new or not.

    Returns:
        How to open it.
    """
    module = load_format(to)
    if out.name and to in _FILES and out.suffix.lower() != f".{to}":
        raise InputError(f"{out} must end in .{to}, by which jbrep data import knows the format")
    if not len(dataset):
        raise InputError(f"{dataset.folder} has no rows yet")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        rows = len(dataset) * dataset.manifest.settings.row_bytes()
        episodes = dataset.manifest.episodes * module.EPISODE_BYTES
        check_space(out.parent, rows + episodes + _FILE_BYTES)
        how: str = module.write(dataset, out)
    except (OSError, RuntimeError) as error:  # HDF5 raises the latter when the disk is full
        reason = getattr(error, "strerror", None) or error  # some have only a text
        raise InputError(f"can't write {out}: {reason}") from error
    return how


def open_sources(given: Sequence[str], layout: Layout | None = None, missing: str = "") -> Source:
    """Open what is to be imported together, each as `open_source` does."""
    paths = [Path(each).resolve() for each in given]
    for i, path in enumerate(paths):
        if path in paths[:i]:
            raise InputError(f"{given[i]} is given twice: its episodes would be there twice")
    return together([open_source(each, layout, missing) for each in given])


def open_source(given: str, layout: Layout | None = None, missing: str = "") -> Source:
    """Open what is to be imported.

    Args:
        given: a file of a kind in `_FILES`, the folder of a LeRobot or Minari data set, or the id
            of the latter.
        layout: what the columns of a table are.
        missing: what becomes of numbers that are missing in a table, see `without_missing`.

    Raises:
        ModuleNotFoundError: its format needs a package that isn't installed.
    """
    module = load_reader(given)
    if hasattr(module, "open_table"):
        from jbrep.dataset.formats.logs import source_of_table

        return source_of_table(module.open_table(given), layout, missing)
    if layout not in (None, Layout()):
        raise InputError(f"{given} names its arrays itself: only a table's columns can be named")
    opened: Source = module.open_source(given)
    return opened


def load_reader(given: str) -> ModuleType:
    """Import what reads a file or folder, without opening it.

    Raises:
        ModuleNotFoundError: its format needs a package that isn't installed.
    """
    path = Path(given)
    suffix = path.suffix.removeprefix(".").lower()
    is_file = exists(path) and not path.is_dir()
    if is_file and not path.is_file():
        raise InputError(f"{path} is a pipe or a device: it must be a regular file")
    if is_file and suffix not in _FILES:
        raise InputError(f"unknown format '.{suffix}': choose one of {', '.join(_FILES)}")
    if exists(path / MANIFEST):
        raise InputError(f"{path} is a data set of jbrep's already: there is nothing to import")
    if not exists(path) and suffix in _FILES:
        raise InputError(f"there is no file {path}")
    folders = (name for mark, name in _FOLDERS.items() if exists(path / mark))
    name = _FILES[suffix] if is_file else next(folders, "minari")
    module = import_module(f"{__name__}.{name}")
    if hasattr(module, "open_table"):
        import_module(f"{__name__}.logs")  # imports pyarrow
    return module


def together(sources: Sequence[Source]) -> Source:
    """Several sources as one: the episodes of each in turn."""
    first, *others = sources
    for other in others:
        if differs := _difference(first, other):
            raise InputError(f"{other.name} {differs} {first.name}: import it alone")
    rows = [source.rows or 0 for source in sources]
    return replace(
        first,
        name=f"{first.name} and {counted(len(others), 'more')}" if others else first.name,
        episodes=lambda: chain.from_iterable(source.episodes() for source in sources),
        rows=sum(rows) if all(rows) else None,
        timestep=first.timestep if all(source.timestep for source in sources) else None,
        notes=tuple(dict.fromkeys(note for source in sources for note in source.notes)),
        changes=lambda: sum((Counter(source.changes()) for source in sources), Counter()),
    )


def _difference(one: Source, other: Source) -> str:
    """In what the other isn't like the one, as in `_ALIKE`; empty if in nothing."""
    for what, differs in _ALIKE.items():
        if not np.array_equal(getattr(one, what), getattr(other, what)):
            return differs
    step, another = one.timestep, other.timestep
    if step and another and not math.isclose(step, another, rel_tol=CLOCKS):
        return "has another time from row to row than"
    return ""
