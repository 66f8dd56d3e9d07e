"""Documents: records in JSON files and headers, which say their format and its version first."""

import json
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
        """The text of its file.

        Raises:
            ValueError: a number in it is not finite.
        """
        return json.dumps(self.as_json(), indent=self.indent, allow_nan=False) + "\n"

    def write(self, path: Path) -> None:
        """Write its file, whole or not at all."""
        write_whole(path, self.text().encode())


_Document = TypeVar("_Document", bound=Document)


def read_document(path: Path, kind: type[_Document]) -> _Document:
    """The document that a JSON file holds, every field checked.

    Raises:
        DamageError: it isn't such a document.
    """
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
    """A JSON object from bytes: all its numbers finite, all its text in UTF-8.

    Raises:
        DamageError: it isn't one.
    """
    try:
        return msgspec.json.decode(raw, type=dict[str, Any])
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise DamageError(f"{path} is damaged, or not a {what} file: {error}") from None
