"""Which columns of a table are numbers, to be aligned on the right and sorted by value."""

import re
from collections.abc import Sequence

_NUMBER = re.compile(r"[<>]? ?-?[\d,]*\.?\d+(e[-+]?\d+)?( \[.*\]| \(\d+/\d+\))?")
_NO_NUMBER = re.compile(r"-( \(\d+/\d+\))?")


def are_numbers(rows: Sequence[Sequence[str]]) -> list[bool]:
    """For each column, whether all its cells are numbers, intervals or dashes."""
    return [all(map(_is_number, column)) for column in zip(*rows, strict=True)]


def _is_number(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _NO_NUMBER.fullmatch(cell))
