"""JSON values checked against type hints and turned into them."""

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints, is_typeddict

from jbrep.errors import DamageError, check_version

Readers = Mapping[Any, Callable[[Any], Any]]  # by type: how to read values of that type
_hints = cache(get_type_hints)  # slow, and asked for at each feature of a task


def read_json(text: str, path: Path, kind: str, known: int) -> dict[str, Any]:
    """A JSON file that says its format and version, as a dict.

    Args:
        text: of the file.
        path: of the file, for messages.
        kind: its format.
        known: the newest format version that can be read.

    Raises:
        DamageError: it is damaged, or of another format.
        InputError: its version is too new.
    """
    try:
        value = json.loads(text, parse_constant=_refuse)
        if value["format"] != kind:
            raise ValueError
        version = value["format_version"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise DamageError(f"{path} is damaged, or not a {kind} file") from None
    check_version(path, version, known)
    return dict(value)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(constant)


def typed(value: Any, kind: Any, readers: Readers | None = None, where: str = "") -> Any:
    """A JSON value as a type: its parts are checked, dataclasses and tuples are made.

    Keys of a typed dict beyond its own are kept, those of a dataclass are ignored. Text comes back
    with a question mark for each character that UTF-8 can't encode.

    Args:
        value: as json.loads returns it.
        kind: a type hint made of dataclasses, typed dicts, mappings, lists, tuples, unions,
            literals, scalars and the types of `readers`.
        readers: how to read other types; they raise a ValueError for what doesn't fit.
        where: the value stands, for messages.

    Raises:
        ValueError: a part doesn't fit; the message says which.
    """
    readers = readers or {}

    def part(of: Any, kind: Any, name: str) -> Any:
        return typed(of, kind, readers, f"{where}{name}")

    if kind in readers:
        try:
            return readers[kind](value)
        except (ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"{where}: {error}") from None
    origin = get_origin(kind)
    if origin is UnionType:
        return _first_that_fits(value, kind, readers, where)
    if is_typeddict(kind) or (isinstance(kind, type) and is_dataclass(kind)):
        return _record(value, kind, part, where)
    if origin in (list, tuple):
        return _sequence(value, kind, part, where)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        _need(isinstance(value, dict), where, "an object")
        return {_text(key): part(each, get_args(kind)[1], f".{key}") for key, each in value.items()}
    return _scalar(value, kind, where)


def _first_that_fits(value: Any, kind: Any, readers: Readers, where: str) -> Any:
    for option in get_args(kind):
        try:
            return typed(value, option, readers, where)
        except ValueError as error:
            last = error
    raise last


def _record(value: Any, kind: Any, part: Callable[..., Any], where: str) -> Any:
    """A typed dict or a dataclass."""
    _need(isinstance(value, dict), where, "an object")
    typed_dict = is_typeddict(kind)
    required = kind.__required_keys__ if typed_dict else {field.name for field in fields(kind)}
    missing = ", ".join(sorted(required - value.keys()))
    _need(not missing, where, f"complete: {missing} is missing")
    own = {
        name: part(value[name], hint, f".{name}")
        for name, hint in _hints(kind).items()
        if name in value
    }
    if typed_dict:
        return {_text(name): own.get(name, _clean(each)) for name, each in value.items()}
    try:
        return kind(**own)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _sequence(value: Any, kind: Any, part: Callable[..., Any], where: str) -> Any:
    """A list, or a tuple of one type or of one for each part."""
    _need(isinstance(value, list), where, "a list")
    kinds = get_args(kind)
    if get_origin(kind) is list or kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    _need(len(value) == len(kinds), where, f"a list of {len(kinds)}")
    parts = enumerate(zip(value, kinds, strict=True))
    return get_origin(kind)(part(each, of, f"[{i}]") for i, (each, of) in parts)


_SCALARS = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}


def _scalar(value: Any, kind: Any, where: str) -> Any:
    if kind is Any:
        try:
            return _clean(value)
        except RecursionError:
            _need(False, where, "nested less deeply")
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        _need(value in choices, where, f"one of {', '.join(choices)}")
        return value
    if kind is NoneType:
        _need(value is None, where, "null")
        return value
    if kind is float:
        _need(type(value) in (int, float) and abs(value) <= sys.float_info.max, where, "a number")
        return float(value)
    _need(type(value) is kind, where, _SCALARS[kind])
    return _text(value) if kind is str else value


def _clean(value: Any) -> Any:
    """Any JSON value with text that can be written."""
    if isinstance(value, dict):
        return {_text(name): _clean(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_clean(each) for each in value]
    return _text(value) if isinstance(value, str) else value


def _text(text: str) -> str:
    return text.encode(errors="replace").decode()


def _need(fits: bool, where: str, what: str) -> None:
    if not fits:
        raise ValueError(f"{where.removeprefix('.') or 'the file'} must be {what}")
