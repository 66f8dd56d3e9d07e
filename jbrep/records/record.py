"""Records: what a file or a table of settings holds, each as one frozen class.

A field says its type, its range and its words once::

    steps: Annotated[int, Meta(ge=1, le=10**12, description="Of training.")] = 100_000

From that follow the check of each value that is given, with a message of one line, the JSON that
files hold, the options of the command line and the tables in docs/. msgspec reads the types:
https://jcristharif.com/msgspec/constraints.html
"""

import re
import sys
from typing import Annotated, Any, Self, TypeVar

import msgspec
from msgspec import NODEFAULT, UNSET, Meta, inspect
from msgspec.structs import force_setattr

from jbrep.errors import InputError
from jbrep.records.words import at, bare, must_be, type_of
from jbrep.text import printable

_Kind = TypeVar("_Kind")

MOST_WHOLE = 1 << 53  # that floats hold, as they do all whole numbers below
_LARGEST = sys.float_info.max
Finite = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST, title="a finite number")]

Version = Annotated[
    str,
    Meta(pattern=r"(?a)\A\w[\w.+!-]*\Z", title="a version, or the name of a package"),
]
Sha256 = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z", title="64 hexadecimal digits")]

_AT = re.compile(r"(?P<reason>.*?)(?: - at `\$(?P<path>.*)`)?", re.DOTALL)
_MISSING = re.compile(r"Object missing required field `(.*)`")
_UNKNOWN = re.compile(r"Object contains unknown field `(.*)`")
_OF_MSGSPEC = re.compile(r"Expected |Invalid |Number out of range|Integer value out of range")
_MOST_SHOWN = 60  # letters of a value


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, dict=True):
    """A frozen record whose fields are checked when it is made, in Python or from a file.

    A list is taken for a tuple, a whole number for a float, a NumPy scalar for Python's.
    """

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(type(self)):
            value = getattr(self, field.name)
            if field.type is not Any and value is not UNSET:
                fitting = converted(_of_python(value), field.type, field.encode_name)
                force_setattr(self, field.name, fitting)
        self.check()

    def check(self) -> None:
        """Check what no field can say alone."""

    def replace(self, **changes: Any) -> Self:
        """The same with other values of some fields, checked again."""
        return msgspec.structs.replace(self, **changes)


def from_plain(value: Any, kind: type[_Kind], where: str = "") -> _Kind:
    """A record, or any other type, from plain JSON or TOML.

    Args:
        value: as json.loads or tomllib.loads return it.
        kind: the class, or another type that msgspec knows.
        where: the value stands, for messages: "data" makes them speak of data.steps.
    """
    return converted(value, kind, where)


def from_text(text: str, kind: Any, where: str) -> Any:
    """A value of a type from text, as people write it: 0.5, or 1,5,10, or size=2,mass=0.5."""
    parts = [part.strip() for part in text.split(",")]
    match bare(type_of(kind)):
        case inspect.CollectionType():
            return converted(parts, kind, where, strict=False)
        case inspect.DictType() if all("=" in part for part in parts):
            pairs = dict(part.split("=", 1) for part in parts)
            return converted(pairs, kind, where, strict=False)
    return converted(text, kind, where, strict=False)


def converted(value: Any, kind: Any, where: str, strict: bool = True) -> Any:
    """As `from_plain`, for types that aren't classes; not strict of numbers that are text."""
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise InputError(_said(str(error), value, kind, where)) from None
    except RecursionError:
        raise InputError(f"{where or 'it'} must be nested less deeply") from None


def to_plain(value: Any) -> Any:
    """A record, or what holds some, as plain JSON: its fields in order, tuples as lists."""
    return _with_lists(msgspec.to_builtins(value, enc_hook=_python_scalar))


def _of_python(value: Any) -> Any:
    """A NumPy scalar as Python's; anything else as it is."""
    return value.item() if hasattr(value, "dtype") and not getattr(value, "shape", 0) else value


def _python_scalar(value: Any) -> Any:
    if (plain := _of_python(value)) is value:
        raise TypeError(f"it is of type {type(value).__name__}")
    return plain


def _with_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _with_lists(each) for name, each in value.items()}
    return [_with_lists(each) for each in value] if isinstance(value, list | tuple) else value


def _said(message: str, value: Any, kind: Any, where: str) -> str:
    """An error of msgspec's as a line for people."""
    found = _AT.fullmatch(message)
    reason, path = (found["reason"], found["path"] or "") if found else (message, "")
    part = at(value, kind, path)
    name = f"{where}{part.name}".removeprefix(".")
    if missing := _MISSING.fullmatch(reason):
        return f"{_inside(name, missing[1])} is missing"
    if unknown := _UNKNOWN.fullmatch(reason):
        names = f"it must be one of {', '.join(part.names)}" if part.names else "there are none"
        return f"unknown {_inside(name, unknown[1])}: {names}"
    if not _OF_MSGSPEC.match(reason):  # what `check` said
        return f"{name}: {reason}" if name else reason
    if part.value is UNSET:
        return f"{name} must be {must_be(part.kind)}"
    return f"{name or 'it'} is {shown(part.value)}: it must be {must_be(part.kind)}"


def _inside(name: str, field: str) -> str:
    return f"{name}.{field}" if name else field


def shown(value: Any) -> str:
    """A value in a message: short, on one line, and with nothing that controls a terminal."""
    text = value if isinstance(value, str) else ascii(_plain_or_text(value))
    text = printable(text)
    text = text if len(text) <= _MOST_SHOWN else f"{text[: _MOST_SHOWN - 3]}..."
    return repr(text) if isinstance(value, str) else text


def _plain_or_text(value: Any) -> Any:
    """A value as plain JSON where that can be."""
    try:
        return to_plain(value)
    except (TypeError, ValueError, RecursionError):
        return f"of type {type(value).__name__}"


def default_of(field: msgspec.structs.FieldInfo) -> Any:
    """A field's default; NODEFAULT where there is none."""
    return field.default if field.default_factory is NODEFAULT else field.default_factory()
