"""Tables as text."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

SIGNIFICANT = ",.3g"  # a format for `number`: three digits


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """As CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns side by side: the first aligned on the left, the others on the right."""
    lines = [header, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def interval(values: list[float | None], form: str) -> str:
    """A value with its interval, if it has one: 1.08 [1.07, 1.09]."""
    value, low, high = (number(v, form) for v in values)
    return value if values[1] is None else f"{value} [{low}, {high}]"


def number(value: float | None, form: str) -> str:
    """A number in that format, or a dash where there is none."""
    if value is None:
        return "-"
    if form == SIGNIFICANT and abs(value) >= 1000:
        form = ",.0f"  # 1,190, not 1.19e+03
    return format(value, f"z{form}")  # no negative zero
