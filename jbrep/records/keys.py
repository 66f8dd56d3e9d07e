"""The keys that a record has, as its options on the command line and the docs tell of them."""

from typing import Any, NamedTuple

import msgspec
from msgspec import NODEFAULT, UNSET, inspect

from jbrep.records.record import Record, default_of, type_of


class Key(NamedTuple):
    """A key of a record in files, of the record's field."""

    name: str  # in files
    field: str  # in Python
    kind: inspect.Type
    annotation: Any  # the same as Python has it
    default: Any  # NODEFAULT: it must be given
    help: str  # what it means
    default_in_words: str  # where the default stands for what other settings decide; often empty

    @property
    def default_shown(self) -> str:
        """The default for a reader; empty where there is none, or it says nothing."""
        value = self.default
        if self.default_in_words or value in (NODEFAULT, UNSET, None, ""):
            return self.default_in_words
        if isinstance(value, Record | dict | tuple | frozenset):
            return ""
        if isinstance(value, bool):
            return str(value).lower()
        return f"{value:,}" if isinstance(value, int) else str(value)


def keys_of(kind: type[Record]) -> list[Key]:
    """The keys of a record, in order.

    A field says what its default stands for by `Meta(extra={"default": "ten times as many"})`.
    """
    node = type_of(kind)
    assert isinstance(node, inspect.StructType)
    keys = []
    for each, field in zip(node.fields, msgspec.structs.fields(kind), strict=True):
        told = each.type if isinstance(each.type, inspect.Metadata) else None
        words = (told and told.extra_json_schema) or {}
        extra = (told and told.extra) or {}
        keys.append(
            Key(
                each.encode_name,
                each.name,
                each.type,
                field.type,
                default_of(field),
                words.get("description", ""),
                str(extra.get("default", "")),
            )
        )
    return keys


def option_name(key: str) -> str:
    """The option that gives a key: --batch-size."""
    return f"--{key.replace('_', '-')}"
