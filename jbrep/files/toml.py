"""TOML files, as users write them."""

import os
import tomllib
from pathlib import Path
from typing import Any

from jbrep.errors import InputError
from jbrep.files.storage import read_file

_MAX_BYTES = 1 << 20


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file, or of the one that a link leads to.

    Raises:
        InputError: it can't be read, is empty or larger than a MiB, or isn't valid TOML.
    """
    content = read_file(Path(os.path.realpath(path)), _MAX_BYTES)
    try:
        return tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
