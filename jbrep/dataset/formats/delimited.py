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
import pyarrow.compute as pc
import pyarrow.csv as pa_csv

from jbrep.dataset.formats.frame import PEEKED, About, Frame, label_of
from jbrep.dataset.formats.roles import DEGREES, RADIANS, SECONDS
from jbrep.errors import InputError, first_line, refusing

_SEPARATORS = ",;\t|"
_SAID = re.compile(r"\"?sep=(.)\"?")  # the separator, as a first line for Excel
_COMMENTS = ("#", "%")
_MISSING = [*pa_csv.ConvertOptions().null_values, "None", "NAN", "Nan"]
_EMPTY = [*_MISSING, "-", "--"]  # which stand for no unit, too
_WORDS = ("nan", "inf", "infinity", "true", "false")  # that may be names
_UNIT = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\])]*)[\])]")
_TELLING = {*RADIANS, *DEGREES, *SECONDS}  # units that change what numbers mean
_PLACE = re.compile(r"\w[\[(]\d+[\])]$")  # of q[0], which is no unit
_LONG = re.compile(r"-?\d{16,}")  # whole numbers that may lose digits as floats
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_NUMBERS, _TIMES = (pa.float64(), pa.bool_()), (pa.timestamp("ns"), pa.timestamp("ns", "UTC"))
_TIME_FORMS = (  # of loggers, and what stands for them in ISO 8601
    (r",(\d{1,9})", r".\1"),  # Python's logging: 11:59:58,010
    (r"([+-]\d\d)$", r"\1:00"),  # PostgreSQL: +00
    (r" ?([+-]\d\d)(\d\d)$", r"\1:\2"),  # +0000
    (r" (UTC|GMT|Z)$", "Z"),
)
_PROBLEM = re.compile(r"In CSV column #(\d+): (?:Row #(\d+): )?.*?: (.*)")
_SHORT = re.compile(r"CSV parse error: (?:Row #(\d+): )?(Expected .* got \d+)")
_BLOCK = 1 << 20  # bytes read at a time


class _Form(NamedTuple):
    separator: str
    decimal: str
    begin: int  # lines before the first row
    schema: pa.Schema
    units: list[str]
    rewritten: set[str]  # columns of times that aren't in ISO 8601


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
        place=lambda row: f"line {_line_of(path, form, row)}",
    )


def _form(path: Path) -> _Form:
    begin, said, lines = _head(path)
    separator = said or max(_SEPARATORS, key=lines[0].count)
    with refusing(f"{path} can't be read as rows of text", (csv.Error,), describe=first_line):
        read = csv.reader(lines, delimiter=separator)
        header, *rows = ([cell.strip() for cell in row] for row in read)
    if any(_type(cell) == pa.float64() and cell.lower() not in _WORDS for cell in header if cell):
        raise InputError(f"{path}, line {begin + 1}: a number where the columns must be named")
    names, units = _names(header)
    if len(rows) > 1 and len(rows[0]) == len(names) and _is_line_of_units(*rows[:2]):
        below = [cell.strip("[]()").strip() for cell in rows.pop(0)]
        begin, units = begin + 1, [a or b for a, b in zip(units, below, strict=True)]
    decimal = _decimal(path, separator, [cell for row in rows for cell in row])
    types, rewritten = list[pa.DataType](), set[str]()
    for i, name in enumerate(names):
        cells = [row[i] for row in rows if i < len(row) and row[i] not in _EMPTY]
        types.append(_type(cells[0], decimal) if cells else pa.float64())
        if types[i] == pa.string() and (kind := _type(_iso_cell(cells[0]))) in _TIMES:
            types[i] = kind
            rewritten.add(name)
    schema = pa.schema(zip(names, types, strict=True))
    return _Form(separator, decimal, begin + 1, schema, units, rewritten)


def _head(path: Path) -> tuple[int, str, list[str]]:
    """Lines before the names; the separator, if one of them says it; the names and first rows."""
    refused = refusing(f"{path} can't be read as text in UTF-8", (OSError, ValueError))
    with refused, path.open(encoding="utf-8-sig") as file:
        said = ""
        for begin, line in enumerate(file):
            if found := _SAID.fullmatch(line.rstrip("\r\n")):
                said = found[1]
            elif line.strip() and line[0] not in _COMMENTS:
                return begin, said, [each.rstrip("\n") for each in (line, *islice(file, PEEKED))]
    raise InputError(f"{path} is empty: its first line must name the columns")


def _decimal(path: Path, separator: str, cells: list[str]) -> str:
    """The decimal mark; only between semicolons a comma is surely one, and no mark of thousands."""
    commas = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell)]
    if sum("." in cell and _type(cell) == pa.float64() for cell in cells) > len(commas):
        return "."  # commas are in some text
    if separator != ";" and commas and all(map(_THOUSANDS.fullmatch, commas)):
        raise InputError(
            f"{path} has numbers such as {commas[0]}, of which it can't be told whether the comma "
            "is a decimal mark: write them without marks for thousands"
        )
    return "," if commas else "."


def _is_line_of_units(row: list[str], following: list[str]) -> bool:
    def has_value(cells: list[str]) -> bool:
        return any(c and (c in _MISSING or _type(_iso_cell(c), ",") != pa.string()) for c in cells)

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
    is_time = ":" in cell
    for kind in _TIMES if is_time else _NUMBERS:
        with suppress(pa.ArrowInvalid):
            pa.scalar(cell if is_time else cell.replace(decimal, ".")).cast(kind)
            return kind
    return pa.string()


def _iso_cell(cell: str) -> str:
    return str(_iso(pa.array([cell]))[0])


def _iso(cells: pa.Array) -> pa.Array:
    """Times as ISO 8601 has them."""
    for pattern, instead in _TIME_FORMS:
        cells = pc.replace_substring_regex(cells, pattern, instead)
    return cells


def _batches(path: Path, form: _Form, columns: list[str]) -> Iterator[pa.RecordBatch]:
    lines = {"use_threads": False, "block_size": _BLOCK}  # threads lose count of the lines
    cells = {"null_values": _EMPTY, "strings_can_be_null": True, "decimal_point": form.decimal}
    kinds = {each.name: each.type for each in form.schema}
    kinds |= dict.fromkeys(form.rewritten, pa.string())
    try:
        with (
            path.open("rb") as file,
            pa_csv.open_csv(
                file,
                pa_csv.ReadOptions(skip_rows=form.begin, column_names=form.schema.names, **lines),
                pa_csv.ParseOptions(delimiter=form.separator, newlines_in_values=True),
                pa_csv.ConvertOptions(column_types=kinds, include_columns=columns, **cells),
            ) as reader,
        ):
            for batch in reader:
                yield _with_times(batch, form)
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}{_problem_at(path, form, first_line(error))}") from None


def _with_times(batch: pa.RecordBatch, form: _Form) -> pa.RecordBatch:
    for name in form.rewritten & {*batch.schema.names}:
        i, kind = batch.schema.get_field_index(name), form.schema.field(name).type
        batch = batch.set_column(i, name, _iso(batch.column(name)).cast(kind))
    return batch


def _problem_at(path: Path, form: _Form, problem: str) -> str:
    """An error of Arrow's, with line and column; it counts on from the lines before the first."""

    def at(row: str | None) -> str:
        return f", line {_line_of(path, form, int(row) - form.begin - 1)}" if row else ""

    if found := _PROBLEM.fullmatch(problem):
        return f"{at(found[2])}, column {form.schema.names[int(found[1])]!r}: {found[3]}"
    if found := _SHORT.match(problem):
        return f"{at(found[1])}: {found[2].lower()}"
    return f" can't be read as rows of text: {problem}"


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
