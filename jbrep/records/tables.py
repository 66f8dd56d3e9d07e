"""Tables as CSV."""

import csv
import hashlib
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from jbrep.errors import DamageError
from jbrep.records.record import MOST_WHOLE
from jbrep.records.storage import read_file, write_whole

_Row = TypeVar("_Row", bound=NamedTuple)
Columns = Mapping[str, Callable[[str], Any]]  # by their names: what their cells are

_LARGEST = 1e100


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A header and rows as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Write a table, whole or not at all; returns its SHA-256."""
    return write_text(path, csv_text(columns, rows))


def write_text(path: Path, text: str) -> str:
    """The same of a table as text."""
    write_whole(path, text.encode())
    return hashlib.sha256(text.encode()).hexdigest()


def read_csv(
    path: Path,
    columns: Columns,
    sha256: str | None = None,
    further: Callable[[str], Any] | None = None,
) -> list[tuple[Any, ...]]:
    """The rows below the header, each cell as its column has it.

    Args:
        path: of the file.
        columns: the header must have these, and no others unless `further` is given.
        sha256: of the file, if it is known.
        further: what cells of all other columns are; each row then ends with a dictionary of them.
    """
    raw = read_file(path)
    if sha256 is not None and hashlib.sha256(raw).hexdigest() != sha256:
        raise DamageError(
            f"{path} was changed after it was written, or is damaged: its checksum doesn't match"
        )
    try:
        header, *rows = csv.reader(io.StringIO(raw.decode(), newline=""), strict=True)
        count, others = len(columns), header[len(columns) :]
        if header[:count] != [*columns] or (others and further is None):
            raise ValueError
        kinds = [*columns.values(), *[further or str] * len(others)]
        cells = [tuple(k(cell) for k, cell in zip(kinds, row, strict=True)) for row in rows]
        if further is None:
            return cells
        return [(*row[:count], dict(zip(others, row[count:], strict=True))) for row in cells]
    except (ValueError, csv.Error):
        raise DamageError(f"{path} is damaged or cut short") from None


def write_rows(path: Path, rows: Iterable[NamedTuple], kind: type[NamedTuple]) -> str:
    """As `write_csv`, of columns that are the fields of rows: text, counts and numbers."""
    return write_csv(path, [*map(_column, kind._fields)], ([*map(_cell, row)] for row in rows))


def read_rows(path: Path, kind: type[_Row], sha256: str) -> list[_Row]:
    """What `write_rows` wrote."""
    cells: dict[type, Callable[[str], Any]] = {str: str, int: count, float: finite}
    columns = {_column(name): cells[of] for name, of in kind.__annotations__.items()}
    return [kind._make(row) for row in read_csv(path, columns, sha256)]


def _cell(value: str | float) -> str | int:
    if isinstance(value, float):
        return f"{value:.6g}" if 0 < abs(value) < 1 else f"{value:.3f}"
    return value if isinstance(value, str) else int(value)


def as_in_tables(value: float) -> float:
    """A number as tables have it: three decimals, or six digits of one below 1."""
    return float(_cell(float(value)))


def _column(field: str) -> str:
    return field.removeprefix("episode_")  # of episode_return, as return is a word of Python's


def count(cell: str) -> int:
    """A whole number from 0, or a ValueError."""
    number = int(cell)
    if not 0 <= number < MOST_WHOLE:
        raise ValueError
    return number


def finite(cell: str) -> float:
    """A number, or a ValueError of one so large that its square is infinite."""
    number = float(cell)
    if not abs(number) <= _LARGEST:
        raise ValueError
    return number
