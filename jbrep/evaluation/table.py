"""The scores of encoders as a table, diagnostics.csv, whose columns are known by their names."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jbrep.records.tables import Columns, csv_text, finite, read_csv

if TYPE_CHECKING:
    from jbrep.evaluation.evaluation import Diagnostics

DIAGNOSTICS = "diagnostics.csv"  # of a study, or beside encoders
Values = Mapping[str, float | None]  # by name; None, or nothing, where it isn't known

_KEY: Columns = dict.fromkeys(("task", "representation", "sha256"), str)


class Diagnosed(NamedTuple):
    """A row of the table: an encoder, and its numbers."""

    task: str
    representation: str  # what tables call it; several encoders of a study may share a name
    sha256: str  # of the encoder
    values: Values


def headline(known: "Diagnostics") -> dict[str, float | None]:
    """The numbers of an encoder without their intervals."""
    return {name: score.value for name, score in known.scores.items()}


def diagnostics_text(rows: Sequence[Diagnosed]) -> str:
    """The table as its file has it: a column for every number that is known of any encoder."""
    names = dict.fromkeys(name for row in rows for name in row.values)
    cells = ((*row[:3], *(_cell(row.values.get(name)) for name in names)) for row in rows)
    return csv_text([*_KEY, *names], cells)


def read_diagnostics(path: Path, sha256: str | None = None) -> list[Diagnosed]:
    """The rows of the table, with whatever numbers it has."""
    rows = read_csv(path, _KEY, sha256, further=lambda cell: finite(cell) if cell else None)
    return [Diagnosed(*row) for row in rows]


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def by_label(rows: Iterable[Diagnosed]) -> dict[tuple[str, str], dict[str, float | None]]:
    """The values of each task and representation: the mean over its encoders that have one."""
    groups: dict[tuple[str, str], dict[str, list[float]]] = {}
    for row in rows:
        known = groups.setdefault((row.task, row.representation), {})
        for name, value in row.values.items():
            known.setdefault(name, []).extend([] if value is None else [value])
    return {
        label: {name: math.fsum(each) / len(each) if each else None for name, each in known.items()}
        for label, known in groups.items()
    }
