"""Text for a terminal: numbers, tables and facts that fit its width."""

import math
import os
import re
import shutil
import sys
import textwrap
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain, count
from typing import NamedTuple, TypeVar

SIGNIFICANT = ",.3g"  # three digits
_GAP = "  "  # between columns
_NUMBER = re.compile(r"[<>]? ?-?[\d,]*\.?\d+(e[-+]?\d+)?( \[.*\]| \(\d+/\d+\))?")
_COLUMN = re.compile(r"(step|action|reward)(_\d+)?")
_NO_NUMBER = re.compile(r"-( \(\d+/\d+\))?")
_Item = TypeVar("_Item")


def printable(line: str) -> str:
    """The line without characters that could control a terminal, as names of files may hold."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


class Table(NamedTuple):
    """A table to read, in a terminal, in Markdown or on a page."""

    title: str  # that stands above it, if it has one
    header: tuple[str, ...]  # a name for each column
    rows: Sequence[tuple[str, ...]]  # a cell for each column

    @classmethod
    def of(
        cls, title: str, items: Iterable[_Item], columns: Mapping[str, Callable[[_Item], str]]
    ) -> "Table":
        """A row for each item, with what each column shows of it."""
        rows = [tuple(cell(item) for cell in columns.values()) for item in items]
        return cls(title, tuple(columns), rows)

    @property
    def numeric(self) -> list[bool]:
        """For each column, whether all its cells are numbers, intervals or dashes."""
        return [
            all(_NUMBER.fullmatch(row[i]) or _NO_NUMBER.fullmatch(row[i]) for row in self.rows)
            for i in range(len(self.header))
        ]

    def text(self, width: int | None = None) -> str:
        """The title and the table for a terminal of that width, in columns; None for any."""
        cells = table(self.header, self.rows, width)
        return f"{wrapped(self.title, width)}\n\n{cells}" if self.title else cells


def wrapped(text: str, width: int | None) -> str:
    """Text in lines of at most that width; None leaves it on one line."""
    if width is None:
        return text
    return textwrap.fill(text, width, break_on_hyphens=False, break_long_words=False)


def noted(message: str) -> str:
    """A notice as a terminal shows it: wrapped, but for one with a path, which may be copied."""
    line = printable(f"Note: {message}")
    return line if os.sep in line else wrapped(line, terminal_width())


def terminal_width() -> int:
    """COLUMNS if it is set, else the width of the terminal in characters; without one 80."""
    return shutil.get_terminal_size().columns


def rounded(*values: float) -> list[str]:
    """Numbers to read side by side: whole if one is 100 or more, else with three digits of it."""
    largest = max(abs(value) for value in values)
    decimals = 2 - math.floor(math.log10(largest)) if 0 < largest < 100 else 0
    return [f"{value:z,.{min(decimals, 9)}f}" for value in values]


def table(header: Sequence[str], rows: Iterable[Sequence[str]], width: int | None = None) -> str:
    """Columns side by side: the first aligned on the left, the others on the right.

    A table of more than `width` characters is cut into parts, one below the other, each with the
    first column.
    """
    lines = [header, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n\n".join(
        "\n".join(_line(line, columns, widths) for line in lines)
        for columns in _fitting(widths, width)
    )


def _fitting(widths: Sequence[int], width: int | None) -> list[list[int]]:
    """The columns of each part of a table; the first column comes in each."""
    parts, used = [[0]], widths[0]
    for column in range(1, len(widths)):
        taken = len(_GAP) + widths[column]
        if width is not None and used + taken > width and len(parts[-1]) > 1:
            parts.append([0])
            used = widths[0]
        parts[-1].append(column)
        used += taken
    return parts


def _line(cells: Sequence[str], columns: Sequence[int], widths: Sequence[int]) -> str:
    aligned = (
        cells[column].rjust(widths[column]) if column else cells[0].ljust(widths[0])
        for column in columns
    )
    return _GAP.join(aligned).rstrip()


def facts(named: Mapping[str, str], width: int | None, indent: int = 2) -> str:
    """A line for each fact, its name and its text; those above the width, if any, are wrapped."""
    left = indent + max(map(len, named)) + 1
    return "\n".join(
        textwrap.fill(
            what,
            width or sys.maxsize,
            initial_indent=f"{'':{indent}}{name}".ljust(left),
            subsequent_indent=" " * left,
            break_on_hyphens=False,
        )
        for name, what in named.items()
    )


def interval(values: Sequence[float | None], form: str = SIGNIFICANT) -> str:
    """A value with its interval, if it has one: 1.08 [1.07, 1.09], or 1.08 [1.07, unbounded]."""
    value, *ends = values
    shown = number(value, form)
    if ends == [None, None]:
        return shown
    low, high = ("unbounded" if end is None else number(end, form) for end in ends)
    return f"{shown} [{low}, {high}]"


def number(value: float | None, form: str = SIGNIFICANT) -> str:
    """A number in that format, or a dash for None."""
    if value is None:
        return "-"
    if form == SIGNIFICANT and abs(value) >= 999.5:
        form = ",.0f"  # 1,190, not 1.19e+03
    return format(value, f"z{form}")  # no negative zero


def counted(number: int, noun: str) -> str:
    """So many of something: 1 shard, 2,000 shards."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def r2_text(value: float | None) -> str:
    """An R², or a dash for None; less than nothing isn't told apart: <0."""
    return "<0" if value is not None and round(value, 2) < 0 else number(value, ".2f")


def slug(text: str) -> str:
    """A name for a file or folder: a hyphen for each character but letters, digits, '.', '_', '-'.

    Letters are those of ASCII: dm_control/cheetah-run-v0 becomes dm_control-cheetah-run-v0.
    """
    return re.sub(r"[^A-Za-z0-9._-]", "-", text)


def words(names: Iterable[str]) -> list[str]:
    """Different names for features, as close to those given as a feature's may be.

    Of letters of ASCII, digits, '.', '_' and '-', from a letter on: Greek letters are spelled,
    accents dropped. What is named as a column of every data set gets another name.
    """
    names = [*names]
    found, given = dict[str, None](), {*names}
    for name in names:
        word = re.sub(r"[^A-Za-z0-9_.-]+", "_", "".join(map(_spelled, name)))[:90].strip("_")
        if not word[:1].isalpha() or _COLUMN.fullmatch(word):
            word = f"obs_{word}".rstrip("_")
        numbered = chain([word], (f"{word}_{number}" for number in count(2)))
        found[next(e for e in numbered if e not in found and (e == name or e not in given))] = None
    return [*found]


def _spelled(letter: str) -> str:
    """A letter in ASCII, if there is a way."""
    if letter.isascii():
        return letter
    if (name := unicodedata.name(letter, "")).startswith("GREEK"):
        return name.split(" WITH ")[0].rpartition(" ")[2].lower()
    return unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode() or "_"


def duration(seconds: float) -> str:
    """A duration as text: 40 s, 7.0 min, 12.5 h."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


def percentiles(returns: Iterable[float]) -> dict[str, float]:
    """The median of returns, and their 10th and 90th percentile."""
    import numpy as np

    low, median, high = np.percentile([*returns], (10, 50, 90)).tolist()
    return {"median": median, "p10": low, "p90": high}


def interval_of(returns: Iterable[float]) -> str:
    """The same for a reader: 812 [650, 901]."""
    median, low, high = rounded(*percentiles(returns).values())
    return f"{median} [{low}, {high}]"
