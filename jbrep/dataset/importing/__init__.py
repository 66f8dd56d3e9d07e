"""Importing data sets that were made elsewhere: from Minari, npz, Parquet, or arrays in Python."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from jbrep.dataset.importing.episodes import Source
from jbrep.dataset.importing.writer import write
from jbrep.dataset.manifest import Manifest
from jbrep.envs.task import Task
from jbrep.errors import InputError, choose
from jbrep.files.storage import exists

FORMATS = {name: f"{__name__}.{name}" for name in ("minari", "npz", "parquet")}  # modules


def open_source(given: str) -> Source:
    """Open what is to be imported.

    Args:
        given: an .npz or .parquet file, the folder of a Minari data set, or its id.

    Raises:
        InputError: there is nothing of the kind, or it can't be read.
        ModuleNotFoundError: its format needs a package that isn't installed.
    """
    path = Path(given)
    suffix = path.suffix.removeprefix(".")
    if exists(path) and not path.is_dir():
        suffix = suffix if suffix in FORMATS else f".{suffix}"
        read: Callable[[Path], Source] = import_module(
            choose(suffix, {name: FORMATS[name] for name in ("npz", "parquet")}, "format")
        ).open_file
        return read(path)
    if suffix in FORMATS:
        raise InputError(f"there is no file {path}")
    opened: Source = import_module(FORMATS["minari"]).open_data_set(given)
    return opened


def import_data(given: str, folder: Path, task: Task | None = None) -> tuple[Manifest, str]:
    """Make a data set of one that was made elsewhere.

    Args:
        given: as `open_source` takes it.
        folder: new.
        task: that the data are of; by default the one that the source names, or else one that is
            made from the data alone.

    Returns:
        The manifest, and why the task was made from the data alone; empty if it wasn't.

    Raises:
        InputError: the folder exists already, or the data can't be used; nothing is left then.
    """
    source = open_source(given)
    return write(source, folder, task), "" if task or source.task else source.why_no_task
