"""Data sets in other tools' formats: exported to them, and imported from them or from arrays."""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from jbrep.dataset.formats.episodes import Source
from jbrep.dataset.manifest import MANIFEST
from jbrep.dataset.reader import Dataset
from jbrep.errors import InputError, choose
from jbrep.records.storage import check_allocation, check_space, exists

_FILE_BYTES = 1 << 16  # whatever is in it
FORMATS = {name: f"{__name__}.{name}" for name in ("minari", "parquet", "npz")}  # modules


def load_format(name: str) -> ModuleType:
    """Import what reads and writes a format.

    Raises:
        InputError: an unknown format.
        ModuleNotFoundError: it needs a package that isn't installed.
    """
    return import_module(choose(name, FORMATS, "format"))


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
    module = load_format(to)
    if not len(dataset):
        raise InputError(f"{dataset.folder} has no rows yet")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        rows = len(dataset) * dataset.manifest.settings.row_bytes()
        episodes = dataset.manifest.episodes * module.EPISODE_BYTES
        # HDF5 crashes where a file can't grow, perhaps after the last word of Python
        check = check_allocation if to == "minari" else check_space
        check(out.parent, rows + episodes + _FILE_BYTES)
        how: str = module.write(dataset, out)
    except (OSError, RuntimeError) as error:  # HDF5 raises the latter when the disk is full
        reason = getattr(error, "strerror", None) or error  # some have only a text
        raise InputError(f"can't write {out}: {reason}") from error
    return how


def open_source(given: str) -> Source:
    """Open what is to be imported.

    Args:
        given: an .npz or .parquet file, the folder of a Minari data set, or its id.

    Raises:
        InputError: there is nothing of the kind, or it can't be read.
        ModuleNotFoundError: its format needs a package that isn't installed.
    """
    path, files = Path(given), ("npz", "parquet")
    suffix = path.suffix.removeprefix(".")
    is_file = exists(path) and not path.is_dir()
    if is_file and not path.is_file():
        raise InputError(f"{path} is a pipe or a device: it must be a regular file")
    if is_file and suffix not in files:
        raise InputError(f"unknown format '.{suffix}': choose one of {', '.join(files)}")
    if exists(path / MANIFEST):
        raise InputError(f"{path} is a data set of jbrep's already: there is nothing to import")
    if not is_file and suffix in files:
        raise InputError(f"there is no file {path}")
    opened: Source = load_format(suffix if is_file else "minari").open_source(given)
    return opened
