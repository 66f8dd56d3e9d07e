"""Packages whose names are imported on first use, so that importing them loads nothing heavy."""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any


def exports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """The `__getattr__`, `__dir__` and `__all__` of a package.

    Its names stand once, in what it imports for type checkers, below `if TYPE_CHECKING:`.

    Args:
        package: its name.
    """
    loader: Any = sys.modules[package].__loader__
    blocks = (node for node in ast.parse(loader.get_source(package)).body if type(node) is ast.If)
    imports = (node for block in blocks for node in block.body if type(node) is ast.ImportFrom)
    places = {each.name: str(node.module) for node in imports for each in node.names}

    def load(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(places[name]), name)

    return load, lambda: sorted(places), sorted(places)
