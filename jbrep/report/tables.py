"""The tables that a report is made from, read back from a study's folder."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.errors import InputError, check_version
from jbrep.figures.curves import Return
from jbrep.files.storage import exists
from jbrep.rl.files import read_text
from jbrep.stats import analysis
from jbrep.study import record
from jbrep.study.heuristics import HEURISTIC_RETURNS
from jbrep.study.results import RETURNS, STATISTICS


class Tables(NamedTuple):
    """What a study left."""

    name: str
    record: dict[str, Any]  # runs.json
    statistics: dict[str, Any] | None  # statistics.json
    returns: list[Return]  # returns.csv
    heuristics: dict[str, list[float]]  # heuristics.csv: returns by task


def read_tables(folder: Path) -> Tables:
    """The tables in a folder.

    Raises:
        InputError: it is not of a study, or a file is damaged, missing, or of a newer jbrep.
    """
    if not exists(folder / record.RECORD):
        raise InputError(
            f"{folder} is not of a study: runs below it are expected, or a {record.RECORD}"
        )
    found = _read_json(folder / record.RECORD, record.FORMAT, record.FORMAT_VERSION)
    statistics = None
    if exists(folder / STATISTICS):
        statistics = _read_json(folder / STATISTICS, analysis.FORMAT, analysis.FORMAT_VERSION)
    heuristics: dict[str, list[float]] = {}
    if exists(folder / HEURISTIC_RETURNS):
        for task, _, each in _read_csv(folder / HEURISTIC_RETURNS, (str, int, float)):
            heuristics.setdefault(task, []).append(each)
    rows = _read_csv(folder / RETURNS, (str, str, str, int, int, int, float))
    returns = [Return(*row) for row in rows]
    return Tables(folder.resolve().name, found, statistics, returns, heuristics)


def _read_json(path: Path, kind: str, known: int) -> dict[str, Any]:
    try:
        found = json.loads(read_text(path))
        if found["format"] != kind:
            raise ValueError
        version = found["format_version"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path} is damaged, or no {kind}") from None
    check_version(path, version, known)
    return dict(found)


def _read_csv(path: Path, kinds: tuple[Callable[[str], Any], ...]) -> list[tuple[Any, ...]]:
    """The rows below the header, each cell of its column's kind."""
    try:
        return [
            tuple(kind(cell) for kind, cell in zip(kinds, row, strict=True))
            for row in csv.reader(read_text(path).splitlines()[1:])
        ]
    except ValueError:
        raise InputError(f"{path} is damaged, or cut short") from None
