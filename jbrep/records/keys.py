"""What annotations say: of a record's keys, for options and docs, and of a function's arguments."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import wraps
from inspect import signature
from typing import Any, NamedTuple, ParamSpec, TypeVar

import msgspec
from msgspec import NODEFAULT, UNSET, inspect

from jbrep.records.record import Record, bare, converted, default_of, type_of

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")
_CHECKED = inspect.IntType, inspect.FloatType, inspect.BoolType, inspect.NoneType, inspect.DictType


class Key(NamedTuple):
    """A key of a record in files, of the record's field."""

    name: str  # in files
    field: str  # in Python
    annotation: Any
    default: Any  # NODEFAULT: it must be given
    help: str  # what it means
    extra: Mapping[str, Any] = {}  # what else the annotation says

    @property
    def kind(self) -> inspect.Type:
        """Its type as msgspec has it."""
        return type_of(self.annotation)

    @property
    def default_shown(self) -> str:
        """The default for a reader; empty where there is none, or it says nothing.

        An annotation says what it stands for by `Meta(extra={"default": "each task's own"})`.
        """
        value, words = self.default, str(self.extra.get("default", ""))
        if words or value in (NODEFAULT, UNSET, None, ""):
            return words
        if isinstance(value, Record | Mapping | tuple | frozenset):
            return ""
        if isinstance(value, bool):
            return str(value).lower()
        return f"{value:,}" if isinstance(value, int) else str(value)


def keys_of(kind: type[Record]) -> list[Key]:
    """The keys of a record, in order."""
    node = type_of(kind)
    assert isinstance(node, inspect.StructType)
    keys = []
    for each, field in zip(node.fields, msgspec.structs.fields(kind), strict=True):
        meta = each.type if isinstance(each.type, inspect.Metadata) else None
        words, extra = (meta.extra_json_schema, meta.extra) if meta else (None, None)
        help_ = (words or {}).get("description", "")
        default = default_of(field)
        keys.append(Key(each.encode_name, each.name, field.type, default, help_, extra or {}))
    return keys


def option_name(key: str) -> str:
    """The option that gives a key: --batch-size."""
    return f"--{key.replace('_', '-')}"


def checked(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """A function that refuses numbers and mappings that its annotations don't allow."""
    taken = signature(function)
    kinds = {name: each.annotation for name, each in taken.parameters.items()}
    kinds = {name: kind for name, kind in kinds.items() if _is_checked(kind)}

    @wraps(function)
    def call(*given: _Given.args, **named: _Given.kwargs) -> _Result:
        with suppress(TypeError):  # which the call itself raises
            for name, value in taken.bind(*given, **named).arguments.items():
                if name in kinds:
                    converted(value, kinds[name], name)
        return function(*given, **named)

    return call


def _is_checked(annotation: Any) -> bool:
    try:
        kind = type_of(annotation)
    except (TypeError, NameError):  # of classes, or text that a type checker alone reads
        return False
    kinds = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    return all(isinstance(bare(each), _CHECKED) for each in kinds)
