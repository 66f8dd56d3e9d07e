"""Exporting a data set to other tools' formats."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from jbrep.dataset import Dataset
from jbrep.errors import InputError, choose
from jbrep.records.storage import check_space

FORMATS = {name: f"{__name__}.{name}" for name in ("minari", "parquet", "npz")}  # modules

Write = Callable[[Dataset, Path], str]


def load_format(name: str) -> Write:
    """Import what writes a format.

    Raises:
        InputError: an unknown format.
        ModuleNotFoundError: it needs a package that isn't installed.
    """
    write: Write = import_module(choose(name, FORMATS, "format")).write
    return write


def export(dataset: Dataset, to: str, out: Path) -> str:
    """Write a data set in another format.

    Args:
        dataset: what to write.
        to: a key of `FORMATS`.
        out: a new file; for Minari a folder of Minari data sets, new or not.

    Returns:
        How to open it.

    Raises:
        InputError: an unknown format, no rows, something there already, or it can't be written.
    """
    write = load_format(to)
    if not len(dataset):
        raise InputError(f"{dataset.folder} has no rows yet")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_space(out.parent, len(dataset) * dataset.manifest.settings.row_bytes())
        return write(dataset, out)
    except (OSError, RuntimeError) as error:  # HDF5 raises the latter when the disk is full
        reason = getattr(error, "strerror", None) or error  # some have only a text
        raise InputError(f"can't write {out}: {reason}") from error
