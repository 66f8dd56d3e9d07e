"""Files of plain data: JSON documents, which say their format and its version first, and TOML."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import msgspec

from jbrep.errors import DamageError, InputError
from jbrep.records.record import Record, from_plain, to_plain
from jbrep.records.storage import read_file, write_whole


class Document(Record, frozen=True):
    """What a whole file holds, or the header of one."""

    format: ClassVar[str]
    format_version: ClassVar[int]
    indent: ClassVar[int] = 2

    def as_json(self) -> dict[str, Any]:
        """The document as plain JSON, with its format and version first."""
        return {"format": self.format, "format_version": self.format_version, **to_plain(self)}

    def text(self) -> str:
        """The text of its file; a ValueError if a number in it is not finite."""
        return json.dumps(self.as_json(), indent=self.indent, allow_nan=False) + "\n"

    def write(self, path: Path) -> None:
        """Write its file, whole or not at all."""
        write_whole(path, self.text().encode())


_Document = TypeVar("_Document", bound=Document)


def read_document(path: Path, kind: type[_Document]) -> _Document:
    """The document that a JSON file holds, every field checked."""
    return document_from(parse_json(read_file(path), path, kind.format), path, kind)


def document_from(given: Mapping[str, Any], path: Path, kind: type[_Document]) -> _Document:
    """The same of plain JSON, such as the header of a file; the path is for messages."""
    fields = dict(given)
    if fields.pop("format", None) != kind.format:
        raise DamageError(f"{path} is damaged, or not a {kind.format} file")
    version = fields.pop("format_version", None)
    if version != kind.format_version:
        raise InputError(
            f"{path} has version {version!r} of the {kind.format} format: this jbrep reads version "
            f"{kind.format_version} alone; use the jbrep that wrote it, or make it again"
        )
    try:
        return from_plain(fields, kind)
    except InputError as error:
        raise DamageError(f"{path} is damaged or not a {kind.format} file: {error}") from None


def parse_json(raw: bytes, path: Path, what: str) -> dict[str, Any]:
    """A JSON object from bytes."""
    try:
        return msgspec.json.decode(raw, type=dict[str, Any])
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise DamageError(f"{path} is damaged, or not a {what} file: {error}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file."""
    raw = read_file(path)
    try:
        return tomllib.loads(raw.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None


def toml_text(tables: Mapping[str, Any]) -> str:
    """Tables as TOML; None, which TOML lacks, as the text "none"."""
    import tomli_w  # only writers need it

    return tomli_w.dumps(_without_null(tables))


def _without_null(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _without_null(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_without_null(each) for each in value]
    return "none" if value is None else value
