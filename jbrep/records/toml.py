"""TOML files, as users write them."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jbrep.errors import InputError
from jbrep.records.storage import read_file


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file."""
    try:
        return tomllib.loads(read_file(path).decode())
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
