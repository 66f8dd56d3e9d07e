"""What a type allows, in words, and where in a value an error lies."""

import re
import sys
from functools import cache
from typing import Any, NamedTuple

from msgspec import UNSET, inspect

_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+|\.\.\.)\]")
_LARGEST = sys.float_info.max
_WITH_PARTS = (
    *(inspect.StructType, inspect.NamedTupleType, inspect.DictType),
    *(inspect.CollectionType, inspect.TupleType),
)


class Part(NamedTuple):
    """A part of a value."""

    name: str  # as in settings.steps
    value: Any  # UNSET of a part of a table that msgspec doesn't name
    kind: inspect.Type
    names: tuple[str, ...] = ()  # of the fields that it may have


@cache
def type_of(kind: Any) -> inspect.Type:
    """A type as msgspec sees it."""
    return inspect.type_info(kind)


def at(value: Any, kind: Any, path: str) -> Part:
    """The part of a value at a path such as ".features[0][1]", as msgspec writes it."""
    name, node = "", type_of(kind)
    for field, place in _STEP.findall(path):
        step = field or place
        name += _name(node, step)
        node = _inner(node, step)
        value = _value(value, step)
    plain = bare(node)
    fields = plain.fields if isinstance(plain, inspect.StructType) else ()
    return Part(name, value, node, tuple(each.encode_name for each in fields))


def bare(node: inspect.Type) -> inspect.Type:
    """A type without its description; of a union, the part that has parts."""
    while isinstance(node, inspect.Metadata):
        node = node.type
    if isinstance(node, inspect.UnionType):
        inner = [bare(each) for each in node.types]
        return next((each for each in inner if isinstance(each, _WITH_PARTS)), inner[0])
    return node


def _in_list(node: inspect.Type) -> tuple[inspect.Field, ...]:
    """The fields of a record that is written as a list, in order."""
    match node:
        case inspect.StructType(array_like=True) | inspect.NamedTupleType():
            return node.fields
    return ()


def _inner(node: inspect.Type, step: str) -> inspect.Type:
    """The type of a part; of a union, that of the first type which has such a part."""
    if step.isdecimal() and (fields := _in_list(node)):
        return fields[int(step)].type
    match node:
        case inspect.Metadata(type=inner):
            return _inner(inner, step)
        case inspect.UnionType(types=types):
            structs = [each for each in types if isinstance(each, inspect.StructType)]
            if tags := tuple(each.tag for each in structs if each.tag_field == step):
                return inspect.LiteralType(tags)
            parts = (_inner(each, step) for each in types)
            any_type = inspect.AnyType()
            return next((each for each in parts if each != any_type), any_type)
        case inspect.StructType(fields=fields):
            return next((f.type for f in fields if f.encode_name == step), inspect.AnyType())
        case inspect.CollectionType(item_type=item) if step.isdecimal():
            return item
        case inspect.TupleType(item_types=items) if step.isdecimal():
            return items[int(step)]
        case inspect.DictType(value_type=item):
            return item
    return inspect.AnyType()


def _name(node: inspect.Type, step: str) -> str:
    plain = bare(node)
    if step.isdecimal() and (fields := _in_list(plain)):
        return f".{fields[int(step)].encode_name}"
    if isinstance(plain, inspect.StructType):
        return f".{step}"
    return "" if step == "..." else f"[{step}]"


def _value(value: Any, step: str) -> Any:
    """A part of a value; the value itself where the path doesn't say which part."""
    if step == "...":
        return UNSET
    try:
        if isinstance(value, dict):
            return value[step]
        return value[int(step)] if step.isdecimal() else getattr(value, step)
    except (LookupError, TypeError, AttributeError, ValueError):
        return value


def described(node: inspect.Type) -> dict[str, str]:
    """The title and description that annotations give a type."""
    return node.extra_json_schema or {} if isinstance(node, inspect.Metadata) else {}


def must_be(node: inspect.Type) -> str:
    """What a value must be: "a whole number from 1 to 10"."""
    if title := described(node).get("title"):
        return title
    match node:
        case inspect.Metadata(type=inner):
            return must_be(inner)
        case inspect.UnionType(types=types):
            some = [each for each in types if not isinstance(each, inspect.NoneType)]
            return " or ".join(dict.fromkeys(map(must_be, some)))
        case inspect.LiteralType(values=values):
            return f"one of {', '.join(map(str, values))}"
    return _scalar(node) or _collection(node) or "plain JSON"


def _scalar(node: inspect.Type) -> str:
    match node:
        case inspect.IntType(ge=least, le=most):
            return f"a whole number{_range(least, most)}"
        case inspect.FloatType(gt=above, ge=least, le=most, lt=below):
            beyond = "" if below is None else f" and below {below:,}"
            return f"a number{_range(least, most, above)}{beyond}"
        case inspect.StrType(max_length=most):
            return f"text of at most {most:,} letters" if most else "text"
        case inspect.BoolType():
            return "true or false"
        case inspect.NoneType():
            return "null"
    return ""


def _collection(node: inspect.Type) -> str:
    if fields := _in_list(node):
        return f"a list of {', '.join(each.encode_name for each in fields)}"
    match node:
        case inspect.StructType() | inspect.DictType():
            return "a table"
        case inspect.TupleType(item_types=items):
            return f"a list of {len(items)}: {', '.join(map(must_be, items))}"
        case inspect.CollectionType(item_type=item, min_length=least, max_length=most):
            return _list_of(must_be(item), least or None, most)
    return ""


def _range(least: float | None, most: float | None, above: float | None = None) -> str:
    """A range in words: " from 1 to 10", " above 0 and at most 1", or nothing."""
    upper = most if most is not None and most < _LARGEST else None
    if above is not None:
        return f" above {above:,}" + ("" if upper is None else f" and at most {upper:,}")
    if least is not None and least > -_LARGEST:
        return f" from {least:,}" + ("" if upper is None else f" to {upper:,}")
    return "" if upper is None else f" at most {upper:,}"


def _list_of(item: str, least: float | None, most: float | None) -> str:
    """A list in words: "a list of 1 to 3 numbers", "a list of at most 3, each true or false"."""
    count = _range(least, most)
    count = count.removeprefix(" from") if least and most else count.replace(" from", " at least")
    items = re.sub(r"^an? ((?:finite |whole )?)(name|number|table)\b", r"\1\2s", item)
    if items != item or item.startswith("text"):
        return f"a list of{count} {items}"
    return f"a list{f' of{count}' if count else ''}, each {item}"
