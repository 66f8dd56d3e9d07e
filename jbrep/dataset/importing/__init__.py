"""Importing data sets that were made elsewhere: from Minari, npz, Parquet, or arrays in Python."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from jbrep.dataset.importing.episodes import Source
from jbrep.dataset.importing.writer import write
from jbrep.dataset.manifest import MANIFEST
from jbrep.errors import InputError, choose
from jbrep.records.storage import exists

__all__ = ["FORMATS", "Source", "open_source", "write"]

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
    if exists(path / MANIFEST):
        raise InputError(f"{path} is a data set of jbrep's already: there is nothing to import")
    if suffix in FORMATS:
        raise InputError(f"there is no file {path}")
    opened: Source = import_module(FORMATS["minari"]).open_data_set(given)
    return opened
