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

from jbrep.dataset.formats.frame import PEEKED, About, Frame, label_of
from jbrep.dataset.formats.roles import DEGREES, RADIANS, SECONDS
from jbrep.errors import InputError, first_line, refusing

_FORMS = {",": ".", ";": ".,", "\t": ".", "|": "."}  # separators, and decimal marks with them
_COMMENTS = ("#", "%")
_MISSING = [*pa_csv.ConvertOptions().null_values, "None", "NAN", "Nan"]
_EMPTY = [*_MISSING, "-", "--"]  # which stand for no unit, too
_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\])]*)[\])]")
_TELLING = {*RADIANS, *DEGREES, *SECONDS}  # units that change what numbers mean
_PLACE = re.compile(r"\w[\[(]\d+[\])]$")  # of q[0], which is no unit
_LONG = re.compile(r"-?\d{16,}")  # whole numbers that may lose digits as floats
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_NUMBERS, _TIMES = (pa.float64(), pa.bool_()), (pa.timestamp("ns"), pa.timestamp("ns", "UTC"))
_BLOCK = 1 << 20  # bytes read at a time


class _Form(NamedTuple):
    separator: str
    decimal: str
    begin: int  # lines before the first row
    schema: pa.Schema
    units: list[str]


def read(given: str) -> Frame:
    """Read a text file whose first line, but for comments, names the columns."""
    path = Path(given)
    form = _form(path)
    named = zip(form.schema.names, form.units, strict=True)
    return Frame(
        name=given,
        label=label_of(path.stem),
        schema=form.schema,
        batches=lambda columns: _batches(path, form, columns),
        about={name: About(units=(unit,)) for name, unit in named if unit},
        place=lambda row: f"row {row + 1} below the names",
    )


def _form(path: Path) -> _Form:
    refused = refusing(f"{path} can't be read as text in UTF-8", (OSError, ValueError))
    with refused, path.open(encoding="utf-8-sig") as file:
        numbered = enumerate(line.rstrip("\n") for line in file)
        start = next(((i, s) for i, s in numbered if s.strip() and s[0] not in _COMMENTS), None)
        lines = [line for _, line in islice(numbered, PEEKED)]
    if start is None:
        raise InputError(f"{path} is empty: its first line must name the columns")
    begin, names_line = start
    separator = max(_FORMS, key=names_line.count)
    with refusing(f"{path} can't be read as rows of text", (csv.Error,), told=first_line):
        read = csv.reader([names_line, *lines], delimiter=separator)
        header, *rows = ([cell.strip() for cell in row] for row in read)
    if any(_type(cell) == pa.float64() for cell in header if cell):
        raise InputError(f"{path}, line {begin + 1}: a number where the columns must be named")
    names, units = _names(header)
    if len(rows) > 1 and len(rows[0]) == len(names) and _is_line_of_units(*rows[:2]):
        begin, units = begin + 1, [a or b for a, b in zip(units, rows.pop(0), strict=True)]
    cells = [cell for row in rows for cell in row]
    has_comma = "," in _FORMS[separator] and any(map(_DECIMAL_COMMA.fullmatch, cells))
    decimal, types = "," if has_comma else ".", list[pa.DataType]()
    for i in range(len(names)):
        cells = [row[i] for row in rows if i < len(row) and row[i] not in _EMPTY]
        types.append(_type(cells[0], decimal) if cells else pa.float64())
    return _Form(separator, decimal, begin + 1, pa.schema(zip(names, types, strict=True)), units)


def _is_line_of_units(row: list[str], following: list[str]) -> bool:
    def has_value(cells: list[str]) -> bool:
        return any(c and (c in _MISSING or _type(c, ",") != pa.string()) for c in cells)

    return any(row) and not has_value(row) and has_value(following)


def _names(header: list[str]) -> tuple[list[str], list[str]]:
    """Names and units of a header's cells, such as 'speed [m/s]'."""
    found = [None if _PLACE.search(cell) else _UNIT.fullmatch(cell) for cell in header]
    names = [f["name"] if f else cell for f, cell in zip(found, header, strict=True)]
    units = [f["unit"].strip() if f else "" for f in found]
    several = Counter(names)
    for i, name in enumerate(names):
        if several[name] > 1:  # pos (x) and pos (y)
            names[i], units[i] = header[i], units[i] if units[i] in _TELLING else ""
    return [name or f"column_{i}" for i, name in enumerate(names)], units


def _type(cell: str, decimal: str = ".") -> pa.DataType:
    if _LONG.fullmatch(cell):
        return pa.int64()  # exact, as of times in ns
    for kind in _TIMES if ":" in cell else _NUMBERS:
        with suppress(pa.ArrowInvalid):
            pa.scalar(cell.replace(decimal, ".")).cast(kind)
            return kind
    return pa.string()


def _batches(path: Path, form: _Form, columns: list[str]) -> Iterator[pa.RecordBatch]:
    lines = {"use_threads": False, "block_size": _BLOCK}  # threads lose count of the lines
    cells = {"null_values": _EMPTY, "strings_can_be_null": True, "decimal_point": form.decimal}
    what = f"{path} can't be read as rows of text"
    with (
        refusing(what, (OSError, pa.ArrowException), told=first_line),
        pa_csv.open_csv(
            path,
            pa_csv.ReadOptions(skip_rows=form.begin, column_names=form.schema.names, **lines),
            pa_csv.ParseOptions(delimiter=form.separator, newlines_in_values=True),
            pa_csv.ConvertOptions(column_types=form.schema, include_columns=columns, **cells),
        ) as reader,
    ):
        yield from reader
