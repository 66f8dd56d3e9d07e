"""Text with a row in each line, as loggers write it: CSV, with other separators, too."""

import csv
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.csv as pa_csv

from jbrep.dataset.formats.episodes import label
from jbrep.dataset.formats.tables import DEGREES, RADIANS, SECONDS, UNIT, Table
from jbrep.errors import InputError, first_line
from jbrep.records.record import MOST_WHOLE

_SEPARATORS = ",;\t|"
_COMMENTS = ("#", "%")
_MISSING = [*pa_csv.ConvertOptions().null_values, "None", "NAN", "Nan"]
_EMPTY = [*_MISSING, "-", "--"]  # which stand for no unit, too
_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\])]*)[\])]")
_TELLING = {*RADIANS, *DEGREES, *SECONDS}  # units that change what numbers mean
_PLACE = re.compile(r"\w[\[(]\d+[\])]$")  # of q[0], which is no unit
_WHOLE = re.compile(r"-?[0-9]{1,30}")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d\S*")
_ZONE = re.compile(r"(Z|[+-]\d\d:?\d\d)$")
_PROBLEM = re.compile(r"In CSV column #(\d+): (?:Row #(\d+): )?.*?: (.*)")
_SHORT = re.compile(r"CSV parse error: (?:Row #(\d+): )?(Expected .* got \d+)")
_PEEKED = 200  # lines by which columns get their types
_BLOCK = 1 << 20  # bytes read at a time


class _Form(NamedTuple):
    """How a file is written."""

    names: list[str]
    units: list[str]
    types: list[pa.DataType]
    separator: str
    decimal: str
    begin: int  # lines before the first row


def open_table(given: str) -> Table:
    """Open a text file whose first line, but for comments, names the columns."""
    path = Path(given)
    form = _form(path)
    schema = pa.schema(
        pa.field(name, kind, metadata={UNIT: unit.encode()} if unit else None)
        for name, kind, unit in zip(form.names, form.types, form.units, strict=True)
    )
    return Table(
        given,
        label(path.stem),
        schema,
        lambda columns: _batches(path, form, schema, columns),
        place=lambda row: f"line {_line_of(path, form, row)}",
    )


def _line_of(path: Path, form: _Form, row: int) -> int:
    """The line in which a row begins, from 1; empty lines are no rows."""
    line = form.begin + 1
    with path.open(encoding="utf-8-sig", newline=None, errors="replace") as file:
        rows = csv.reader(islice(file, form.begin, None), delimiter=form.separator)
        with suppress(csv.Error):
            for cells in rows:
                if cells and not row:
                    break
                row -= bool(cells)
                line = form.begin + rows.line_num + 1
    return line + row


def _form(path: Path) -> _Form:
    try:
        with path.open(encoding="utf-8-sig", newline=None) as file:
            numbered = enumerate(line.rstrip("\n") for line in file)
            start = next(((i, s) for i, s in numbered if s.strip() and s[0] not in _COMMENTS), None)
            lines = [line for _, line in islice(numbered, _PEEKED)]
    except UnicodeDecodeError:
        raise InputError(f"{path} can't be read as text: it must be in UTF-8") from None
    except OSError as error:
        raise InputError(f"{path} can't be read: {error.strerror}") from None
    if start is None:
        raise InputError(f"{path} is empty: its first line must name the columns")
    begin, names_line = start
    separator = max(_SEPARATORS, key=names_line.count)
    try:
        header, *rows = (
            [cell.strip() for cell in cells]
            for cells in csv.reader([names_line, *lines], delimiter=separator)
        )
    except csv.Error as error:
        raise InputError(f"{path} can't be read as rows of text: {error}") from None
    if any(map(_is_number, header)):
        raise InputError(f"{path}, line {begin + 1}: a number where the columns must be named")
    names, units = _names(header)
    begin += 1
    if rows and any(rows[0]) and not any(map(_is_value, rows[0])) and len(rows) > 1:
        below = rows.pop(0)
        if len(below) == len(names) and any(map(_is_value, rows[0])):  # a line of units
            units, begin = [a or b for a, b in zip(units, below, strict=True)], begin + 1
    is_comma = separator == ";" and any(_DECIMAL_COMMA.fullmatch(c) for row in rows for c in row)
    decimal = "," if is_comma else "."
    columns = [[row[i] for row in rows if i < len(row)] for i in range(len(names))]
    types = [_type(cells, decimal) for cells in columns]
    return _Form(names, units, types, separator, decimal, begin)


def _names(header: list[str]) -> tuple[list[str], list[str]]:
    """Names and units of a header's cells, such as 'speed [m/s]'."""
    found = [_UNIT.fullmatch(cell) for cell in header]
    found = [None if _PLACE.search(cell) else f for f, cell in zip(found, header, strict=True)]
    names = [f["name"] if f else cell for f, cell in zip(found, header, strict=True)]
    units = [f["unit"].strip() if f else "" for f in found]
    several = Counter(names)
    for i, name in enumerate(names):
        if several[name] > 1:  # pos (x) and pos (y)
            names[i] = header[i]
            units[i] = units[i] if units[i] in _TELLING else ""
    return [name or f"column_{i}" for i, name in enumerate(names)], units


def _type(cells: list[str], decimal: str) -> pa.DataType:
    """The type of a column by its first cells that aren't empty."""
    some = [cell for cell in cells if cell not in _EMPTY]
    if all(cell.lower() in ("true", "false") for cell in some) and some:
        return pa.bool_()
    if all(_DATE.fullmatch(cell) for cell in some) and some:
        return pa.timestamp("ns", tz="UTC" if _ZONE.search(some[0]) else None)
    if any(map(_loses_digits, some)) and all(map(_WHOLE.fullmatch, some)):
        return pa.int64()  # exact, as of times in ns
    if not some or _is_number(some[0].replace(decimal, ".")):
        return pa.float64()
    return pa.string()


def _loses_digits(cell: str) -> bool:
    return bool(_WHOLE.fullmatch(cell)) and abs(int(cell)) > MOST_WHOLE


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _is_value(cell: str) -> bool:
    """Whether it may be a row's: a number, one that is missing, a date or a flag."""
    return bool(
        _is_number(cell.replace(",", "."))
        or _DATE.fullmatch(cell)
        or cell.lower() in ("true", "false")
        or (cell and cell in _MISSING)
    )


def _batches(
    path: Path, form: _Form, schema: pa.Schema, columns: list[str]
) -> Iterator[pa.RecordBatch]:
    """The rows of some columns, some at a time."""
    try:
        with pa_csv.open_csv(
            path,
            pa_csv.ReadOptions(
                use_threads=False,  # which lose count of the lines
                block_size=_BLOCK,
                skip_rows=form.begin,
                column_names=form.names,
            ),
            pa_csv.ParseOptions(delimiter=form.separator, newlines_in_values=True),
            pa_csv.ConvertOptions(
                column_types=schema,
                include_columns=columns,
                null_values=_EMPTY,
                strings_can_be_null=True,
                decimal_point=form.decimal,
            ),
        ) as reader:
            yield from reader
    except (OSError, pa.ArrowException) as error:
        raise InputError(_line(path, form, error)) from None


def _line(path: Path, form: _Form, error: BaseException) -> str:
    """An error of Arrow's, with row and column."""
    text = first_line(error)

    def place(number: str | None) -> str:  # of a row, counted on from the lines before the first
        row = int(number or 0) - form.begin - 1
        return f", line {_line_of(path, form, row)}" if number else ""

    if found := _PROBLEM.fullmatch(text):
        return f"{path}{place(found[2])}, column {form.names[int(found[1])]!r}: {found[3]}"
    if found := _SHORT.match(text):
        return f"{path}{place(found[1])}: {found[2].lower()}"
    return f"{path} can't be read as rows of text: {text}"
