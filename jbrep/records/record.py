"""Records: what a file or a table of settings holds, each as one frozen class.

A field says its type, its range and its words once::

    steps: Annotated[int, Meta(ge=1, le=10**12, description="Of training.")] = 100_000

From that follow the check of each value that is given, the JSON that files hold, the options of the
command line and the tables in docs/. msgspec reads the types:
https://jcristharif.com/msgspec/constraints.html
"""

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from itertools import chain
from typing import Annotated, Any, Self, TypeVar

import msgspec
from msgspec import NODEFAULT, UNSET, Meta, inspect
from msgspec.structs import force_setattr

from jbrep.errors import InputError
from jbrep.text import printable

_Kind = TypeVar("_Kind")

MOST_WHOLE = 1 << 53  # that floats hold, as they do all whole numbers below
_IN_WORDS = "in_words"


def pattern(regex: str, in_words: str, **others: Any) -> Meta:
    """What a text must look like, and that in words, for messages."""
    return Meta(pattern=regex, extra={_IN_WORDS: in_words}, **others)


Finite = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Version = Annotated[str, pattern(r"(?a)\A\w[\w.+!-]*\Z", "a version")]  # or the name of a package
Sha256 = Annotated[str, pattern(r"\A[0-9a-f]{64}\Z", "a SHA-256: 64 hexadecimal digits")]

_FIELD = re.compile(r"Object (missing required|contains unknown) field `(.*)`")
_FRACTION = re.compile(r"\A([+-]?)(\.[0-9]+(?:e[+-]?[0-9]+)?)\Z")  # of a number without its 0
_JSON_TYPES = re.compile(r"`([^`]*)`")  # in msgspec's messages
_WORDS = {"array": "a list", "object": "a table", "str": "text"}
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+|\.\.\.)\]")
_WITH_PARTS = (
    *(inspect.StructType, inspect.NamedTupleType, inspect.DictType),
    *(inspect.CollectionType, inspect.TupleType),
)
_MOST_SHOWN = 60  # letters of a value
_TOO_LARGE = 10**18  # of a whole number that is given as text


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, dict=True):
    """A frozen record whose fields are checked when it is made, in Python or from a file.

    A list is taken for a tuple, a whole number for a float, what NumPy has for Python's own.
    """

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(type(self)):
            value = getattr(self, field.name)
            if field.type is not Any and value is not UNSET:
                fitting = converted(value, field.type, field.encode_name)
                force_setattr(self, field.name, fitting)
        self.check()

    def check(self) -> None:
        """Check what no field can say alone."""

    def replace(self, **changes: Any) -> Self:
        """The same with other values of some fields, checked again."""
        return msgspec.structs.replace(self, **changes)


def from_plain(value: Any, kind: type[_Kind], where: str = "") -> _Kind:
    """A record, or another class, from plain JSON or TOML.

    What it is called in messages is `where`: "data" makes them speak of data.steps.
    """
    return converted(value, kind, where)


def from_text(text: str, kind: Any, where: str) -> Any:
    """A value of a type from text, as people write it: 0.5, or 1,5,10, or size=2,mass=0.5."""
    parts = [part.strip() for part in text.split(",")]
    match bare(type_of(kind)):
        case inspect.IntType():
            return converted(_whole(text, where), kind, where)
        case inspect.CollectionType():
            return converted(parts, kind, where, strict=False)
        case inspect.DictType() if all("=" in part for part in parts):
            pairs = dict(part.split("=", 1) for part in parts)
            return converted(pairs, kind, where, strict=False)
    return converted(text, kind, where, strict=False)


def _whole(text: str, where: str) -> int:
    """A whole number as people write it: 5000000, 5_000_000, 5e6, 5M, 5k."""
    digits = text.replace("_", "").lower()
    factor = {"k": 1_000, "m": 1_000_000}.get(digits[-1:], 1)
    try:
        number = Decimal(digits[:-1] if factor > 1 else digits) * factor
    except ArithmeticError:
        number = Decimal("nan")
    if not (number.is_finite() and abs(number) < _TOO_LARGE and number == int(number)):
        must_be = "a whole number: write it as 5000000, 5_000_000, 5e6 or 5M"
        raise InputError(f"{where} is {shown(text)}: it must be {must_be}")
    return int(number)


def converted(value: Any, kind: Any, where: str, strict: bool = True) -> Any:
    """As `from_plain`, for types that aren't classes; not strict of numbers that are text."""
    try:
        plain = _of_python(value) if strict else with_zeros(_of_python(value))
        return msgspec.convert(plain, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise InputError(_line(str(error), value, kind, where)) from None
    except RecursionError:
        raise InputError(f"{where or 'it'} must be nested less deeply") from None


def with_zeros(value: Any) -> Any:
    """Numbers such as -.5 in text, lists and tables as -0.5, which msgspec takes."""
    if isinstance(value, str):
        return _FRACTION.sub(r"\g<1>0\2", value)
    if isinstance(value, Mapping):
        return {name: with_zeros(each) for name, each in value.items()}
    return [*map(with_zeros, value)] if isinstance(value, list | tuple) else value


def _line(message: str, value: Any, kind: Any, where: str) -> str:
    """A message of msgspec's as a line with the place, the value and what that must be."""
    reason, _, path = message.partition(" - at `$")
    path = path.removesuffix("`")
    steps = [field or index for field, index in _STEP.findall(path)]
    place, found = f"{where}{path}".removeprefix("."), [*_at(type_of(kind), steps)]
    nodes = [node for node, _ in found]
    for step in steps:
        value = _inside(value, step)
    if field := _FIELD.fullmatch(reason):
        name = f"{place}.{field[2]}" if place else field[2]
        if field[1].startswith("missing"):
            return f"{name} is missing"
        return f"unknown {name}: {_choices(nodes, 'it must be one of ') or 'there are none'}"
    if reason.startswith("Expected "):
        must_be = reason.removeprefix("Expected ").partition(", got")[0]
        if "matching regex" in must_be:
            must_be = next((words for _, words in found if words), must_be)
        must_be = _JSON_TYPES.sub(_in_words, must_be)
    elif reason.startswith("Invalid "):
        must_be = _choices(nodes, "one of ") or "another"
    else:  # what `check` said
        return f"{place}: {reason}" if place else reason
    given = "" if value is UNSET else f" is {shown(value)}: it"
    return f"{place or 'it'}{given} must be {must_be}"


def _in_words(types: re.Match[str]) -> str:
    every = [_WORDS.get(each, each) for each in types[1].split(" | ") if each != "null"]
    return " or ".join(every)


def _inside(value: Any, step: str) -> Any:
    """A part of a value; UNSET of one in a dict, which msgspec doesn't name."""
    try:
        return value[int(step) if isinstance(value, list | tuple) else step]
    except (LookupError, TypeError, ValueError):
        return getattr(value, step, UNSET)


def _at(
    node: inspect.Type, steps: Sequence[str] = (), words: str = ""
) -> Iterator[tuple[inspect.Type, str]]:
    """The types that a part of a value may have, with what `pattern` says of them in words.

    Without any steps they are those of the value itself.
    """
    match node:
        case inspect.Metadata(type=inner, extra=extra):
            yield from _at(inner, steps, (extra or {}).get(_IN_WORDS, words))
        case inspect.UnionType(types=types):
            yield from chain(*(_at(each, steps, words) for each in types))
        case _ if not steps:
            yield node, words
        case inspect.StructType(tag_field=tag_field, tag=tag) if tag_field == steps[0]:
            yield inspect.LiteralType((tag,)), ""
        case inspect.StructType(fields=fields, array_like=is_list):
            names = [str(i) if is_list else each.encode_name for i, each in enumerate(fields)]
            if steps[0] in names:
                yield from _at(fields[names.index(steps[0])].type, steps[1:])
        case inspect.CollectionType(item_type=item) | inspect.DictType(value_type=item):
            yield from _at(item, steps[1:])


def _choices(nodes: Sequence[inspect.Type], before: str) -> str:
    values = [each for node in nodes for each in getattr(node, "values", ())]
    fields = (each for node in nodes for each in getattr(node, "fields", ()))
    choices = ", ".join(map(str, values or dict.fromkeys(f.encode_name for f in fields)))
    return choices and f"{before}{choices}"


def type_of(kind: Any) -> inspect.Type:
    """A type as msgspec sees it."""
    return inspect.type_info(kind)


def bare(node: inspect.Type) -> inspect.Type:
    """A type without its description; of a union a list or table, or else the first part."""
    return max((each for each, _ in _at(node)), key=lambda each: isinstance(each, _WITH_PARTS))


def to_plain(value: Any) -> Any:
    """A record, or what holds some, as plain JSON: its fields in order, tuples as lists."""
    return _with_lists(msgspec.to_builtins(value, enc_hook=_python_scalar))


def _of_python(value: Any) -> Any:
    """NumPy's numbers and arrays, in lists and tables, too, as Python's."""
    if hasattr(value, "dtype") and hasattr(value, "tolist"):
        return value.tolist()
    if type(value) is dict:
        return {name: _of_python(each) for name, each in value.items()}
    return [*map(_of_python, value)] if type(value) in (list, tuple) else value


def _python_scalar(value: Any) -> Any:
    if (plain := _of_python(value)) is value:
        raise TypeError(f"it is of type {type(value).__name__}")
    return plain


def _with_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _with_lists(each) for name, each in value.items()}
    return [_with_lists(each) for each in value] if isinstance(value, list | tuple) else value


def shown(value: Any) -> str:
    """A value in a message: short, on one line, and with nothing that controls a terminal."""
    text = value if isinstance(value, str) else ascii(value)
    text = printable(text)
    text = text if len(text) <= _MOST_SHOWN else f"{text[: _MOST_SHOWN - 3]}..."
    return repr(text) if isinstance(value, str) else text


def default_of(field: msgspec.structs.FieldInfo) -> Any:
    """A field's default; NODEFAULT where there is none."""
    return field.default if field.default_factory is NODEFAULT else field.default_factory()
