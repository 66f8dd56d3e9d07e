"""Options of commands, made from the fields of records: name, type, help and default."""

from collections.abc import Callable
from typing import Any, TypeVar

import click
from msgspec import NODEFAULT, inspect

from jbrep.cli.base import COUNT, with_options
from jbrep.records.keys import Key, keys_of, option_name
from jbrep.records.record import Record, bare, converted, from_text

_Command = TypeVar("_Command", bound=Callable[..., Any])
_TYPES: dict[type[inspect.Type], click.ParamType[Any]] = {
    inspect.IntType: COUNT,
    inspect.FloatType: click.FLOAT,
    inspect.BoolType: click.BOOL,
}


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
    keys = {
        key.field: key._replace(default=defaults.get(key.field, key.default))
        for key in keys_of(kind)
    }
    return with_options(*(_option(keys[name]) for name in names or keys))


def _option(key: Key) -> Callable[[_Command], _Command]:
    node = bare(key.kind)
    default = f"  [default: {key.default_in_words}]" if key.default_in_words else ""
    has_default = key.default is not NODEFAULT
    return click.option(
        option_name(key.name),
        key.field,
        type=_TYPES.get(type(node), click.STRING),
        is_flag=isinstance(node, inspect.BoolType),
        metavar=_choices(node),
        required=not has_default,
        default=key.default if has_default and key.default not in ((), {}) else None,
        show_default=bool(key.default_shown and not default and key.default is not False),
        help=key.help + default,
        callback=_check(key),
    )


def _check(key: Key) -> Callable[[click.Context, click.Parameter, Any], Any]:
    """Refuses what the record would refuse, before the command imports what it works with."""

    def check(context: click.Context, option: click.Parameter, value: Any) -> Any:
        if isinstance(value, str):
            return from_text(value, key.annotation, key.name)
        return value if value is None else converted(value, key.annotation, key.name)

    return check


def _choices(node: inspect.Type) -> str | None:
    if isinstance(node, inspect.LiteralType):
        return f"[{'|'.join(str(value) for value in node.values if value)}]"
    return None
