"""Documents: records in JSON files and headers, which say their format and its version first."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import msgspec

from jbrep.errors import DamageError, InputError
from jbrep.records.record import Record, from_plain, to_plain
from jbrep.records.storage import read_regular, write_whole

MAX_BYTES = 1 << 24  # of a JSON file, unless its class says otherwise


class Document(Record, frozen=True):
    """What a whole file holds, or the header of one."""

    format: ClassVar[str]
    format_version: ClassVar[int]
    max_bytes: ClassVar[int] = MAX_BYTES
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
        """Write its file, whole or not at all.

        Raises:
            InputError: it can't be written.
        """
        write_whole(path, self.text().encode())


_Document = TypeVar("_Document", bound=Document)


def read_document(path: Path, kind: type[_Document]) -> _Document:
    """The document that a JSON file holds, every field checked.

    Raises:
        InputError: the file can't be read, or has another version of the format.
        DamageError: it isn't such a document.
    """
    raw = read_regular(path, kind.max_bytes)
    return document_from(parse_json(raw, path, kind.format), path, kind)


def document_from(given: Mapping[str, Any], path: Path, kind: type[_Document]) -> _Document:
    """The same of plain JSON, such as the header of a file; the path is for messages.

    Raises:
        InputError, DamageError: as `read_document`.
    """
    fields = dict(given)
    if fields.pop("format", None) != kind.format:
        raise DamageError(f"{path} is damaged, or not a {kind.format} file")
    version = fields.pop("format_version", None)
    if type(version) is not int or version < 1:
        raise DamageError(f"{path} is damaged: its format version is {version!r}")
    if version != kind.format_version:
        raise InputError(
            f"{path} has version {version} of the {kind.format} format: this jbrep reads version "
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
        value = msgspec.json.decode(raw)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise DamageError(f"{path} is damaged, or not a {what} file: {error}") from None
    if not isinstance(value, dict):
        raise DamageError(f"{path} is damaged, or not a {what} file: it must be an object")
    return value
