"""Options of commands, made from the fields of records: name, type, help and default."""

from collections.abc import Callable
from typing import Any, TypeVar

import click
from msgspec import NODEFAULT, inspect

from jbrep.cli.base import COUNT
from jbrep.records.keys import Key, keys_of
from jbrep.records.record import Record
from jbrep.records.words import bare

_Command = TypeVar("_Command", bound=Callable[..., Any])


def record_options(
    kind: type[Record], *names: str, **defaults: Any
) -> Callable[[_Command], _Command]:
    """The options for a record's fields; the record checks what they are given.

    Args:
        kind: the record's class.
        names: of the fields, in the order of the options; all of them if none is named.
        defaults: by name, where a command has others than the record.

    Returns:
        A decorator of a command, which gets an argument with the name of each field.
    """
    keys = {key.field: key for key in keys_of(kind)}
    chosen = [keys[name] for name in names or keys]

    def decorate(command: _Command) -> _Command:
        for key in reversed(chosen):
            command = _option(key._replace(**_changed(key, defaults)))(command)
        return command

    return decorate


def _changed(key: Key, defaults: dict[str, Any]) -> dict[str, Any]:
    return {"default": defaults[key.field]} if key.field in defaults else {}


def _option(key: Key) -> Callable[[_Command], _Command]:
    node = bare(key.kind)
    is_list = isinstance(node, inspect.CollectionType)
    default = f"  [default: {key.default_in_words}]" if key.default_in_words else ""
    has_default = key.default is not NODEFAULT
    return click.option(
        f"--{key.name.replace('_', '-')}",
        key.field,
        type=_type(bare(node.item_type) if isinstance(node, inspect.CollectionType) else node),
        is_flag=isinstance(node, inspect.BoolType),
        multiple=is_list,
        metavar=_choices(node),
        required=not has_default,
        default=key.default if has_default else None,
        show_default=bool(key.default_shown and not default and key.default is not False),
        help=key.help + default,
    )


def _choices(node: inspect.Type) -> str | None:
    if isinstance(node, inspect.LiteralType):
        return f"[{'|'.join(str(value) for value in node.values if value)}]"
    return None


def _type(node: inspect.Type) -> click.ParamType[Any]:
    match node:
        case inspect.IntType():
            return COUNT
        case inspect.FloatType():
            return click.FLOAT
        case inspect.BoolType():
            return click.BOOL
    return click.STRING
