"""The table of what diagnostics say of encoders: diagnostics.csv, of a study or beside encoders."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jbrep.errors import DamageError, InputError
from jbrep.records.storage import read_regular
from jbrep.records.tables import write_csv

DIAGNOSTICS = "diagnostics.csv"
_KEY = ("task", "representation", "sha256")
_MAX_BYTES = 1 << 24


class Diagnosed(NamedTuple):
    """A row of the table: an encoder, and the headline numbers of its evaluation."""

    task: str
    representation: str  # what tables call it; several encoders of a study may share a name
    sha256: str  # of the encoder
    values: Mapping[str, float | None]  # by name, see `jbrep.evaluate.headline`; None if unknown


def write_diagnostics(path: Path, rows: Sequence[Diagnosed]) -> None:
    """Write the table, a column for each name among the values.

    Raises:
        InputError: it can't be written.
    """
    names = list(dict.fromkeys(name for row in rows for name in row.values))
    cells = ((*row[:3], *(_cell(row.values.get(name)) for name in names)) for row in rows)
    write_csv(path, (*_KEY, *names), cells)


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def read_diagnostics(path: Path) -> list[Diagnosed]:
    """The rows of the table, each with every column among its values.

    Raises:
        InputError: it can't be read.
        DamageError: it is not such a table.
    """
    try:
        text = read_regular(path, _MAX_BYTES).decode()
        header, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
        if tuple(header[:3]) != _KEY or len(set(header)) < len(header):
            raise ValueError
        return [_row(header[3:], row) for row in rows]
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
    except (ValueError, csv.Error):
        raise DamageError(f"{path} is damaged, or not a table of diagnostics") from None


def _row(names: Sequence[str], cells: Sequence[str]) -> Diagnosed:
    task, representation, sha256, *numbers = cells
    values = {n: float(cell) if cell else None for n, cell in zip(names, numbers, strict=True)}
    if not all(value is None or math.isfinite(value) for value in values.values()):
        raise ValueError
    return Diagnosed(task, representation, sha256, values)


def by_label(rows: Iterable[Diagnosed]) -> dict[tuple[str, str], dict[str, float | None]]:
    """The values of each task and representation: the mean over its encoders that have one."""
    groups: dict[tuple[str, str], list[Mapping[str, float | None]]] = {}
    for row in rows:
        groups.setdefault((row.task, row.representation), []).append(row.values)
    return {label: _mean(values) for label, values in groups.items()}


def _mean(several: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    names = dict.fromkeys(name for values in several for name in values)
    known = {name: [v for each in several if (v := each.get(name)) is not None] for name in names}
    return {name: math.fsum(each) / len(each) if each else None for name, each in known.items()}
