"""Documents: records in JSON files and headers, which say their format and its version first.

A file also holds the SHA-256 of its fields, so that damage and changes by hand are noticed.
"""

import hashlib
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import msgspec

from jbrep.errors import DamageError, InputError
from jbrep.records.record import Record, from_plain, to_plain
from jbrep.records.storage import read_regular, write_whole

MAX_BYTES = 1 << 24  # of a JSON file, unless its class says otherwise
_FORMAT = ("format", "format_version")
_HASH = "sha256"


class Document(Record, frozen=True):
    """What a whole file holds, or the header of one."""

    format: ClassVar[str]
    format_version: ClassVar[int]
    max_bytes: ClassVar[int] = MAX_BYTES
    indent: ClassVar[int] = 2

    def as_json(self) -> dict[str, Any]:
        """The document as plain JSON, with its format and version first."""
        return {"format": self.format, "format_version": self.format_version, **to_plain(self)}

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of its fields, as canonical JSON.

        Raises:
            ValueError: a number in it is not finite.
        """
        return str(sealed(self.as_json())[_HASH])

    def text(self) -> str:
        """The text of its file.

        Raises:
            ValueError: as `sha256`.
        """
        return json.dumps(sealed(self.as_json()), indent=self.indent) + "\n"

    def write(self, path: Path) -> None:
        """Write its file, whole or not at all."""
        write_whole(path, self.text().encode())


_Document = TypeVar("_Document", bound=Document)


def read_document(path: Path, kind: type[_Document]) -> _Document:
    """The document that a JSON file holds, every field checked.

    Raises:
        DamageError: it isn't such a document, or not as it was written.
    """
    return document_in(read_regular(path, kind.max_bytes), path, kind)


def document_in(raw: bytes, path: Path, kind: type[_Document]) -> _Document:
    """The document of these bytes, such as those of a part of a file; the path is for messages."""
    given = parse_json(raw, path, kind.format)
    stated = given.pop(_HASH, None)
    document = document_from(given, path, kind)
    if stated != sealed(given)[_HASH]:
        raise DamageError(
            f"{path} was changed after it was written, or is damaged: its checksum doesn't match"
        )
    return document


def sealed(given: Mapping[str, Any]) -> dict[str, Any]:
    """A document as plain JSON, with the SHA-256 of its fields after its format and version.

    Raises:
        ValueError: a number in it is not finite.
    """
    fields = {name: value for name, value in given.items() if name not in (*_FORMAT, _HASH)}
    plain = json.loads(json.dumps(fields, allow_nan=False))  # whose keys are text alone
    canonical = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(canonical.encode()).hexdigest()
    return {**{name: given.get(name) for name in _FORMAT}, _HASH: digest, **fields}


def document_from(given: Mapping[str, Any], path: Path, kind: type[_Document]) -> _Document:
    """The same of plain JSON, such as the header of a file; the path is for messages."""
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
