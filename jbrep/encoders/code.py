"""Encoders that are code: named as module:Class, once the module has been imported on request."""

import inspect
import re
from pathlib import Path
from typing import Any

from jbrep.encoders.base import BaseEncoder, as_encoder
from jbrep.envs.names import import_modules, imported
from jbrep.envs.task import Task
from jbrep.errors import InputError, kind_and_line

_CODE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", re.ASCII)


def is_code(name: object) -> bool:
    """Whether a text names code, as in mymodule:MyEncoder, rather than a file."""
    return isinstance(name, (str, Path)) and _CODE.fullmatch(str(name)) is not None


def import_code(name: str | Path | None) -> None:
    """Import the module of an encoder that a command line names; nothing for another text.

    Raises:
        InputError: as `import_modules`.
    """
    if is_code(name):
        import_modules([str(name).partition(":")[0]])


def make(name: str | Path, task: Task) -> BaseEncoder:
    """The encoder that code names: a class, or a function of no arguments, is called to make it.

    Raises:
        InputError: its module wasn't imported on request, it has no such name, the call fails, or
            as `as_encoder`.
    """
    module, _, path = str(name).partition(":")
    thing: Any = imported(module)
    if thing is None:
        raise InputError(
            f"the encoder {name} is code: importing {module} runs it; if you trust it, add "
            f"--import {module}"
        )
    try:
        for part in path.split("."):
            thing = getattr(thing, part)
        if _makes(thing):
            thing = thing()
    except Exception as error:
        raise InputError(f"can't make the encoder {name}: {kind_and_line(error)}") from error
    return as_encoder(thing, task)


def _makes(thing: Any) -> bool:
    """Whether it makes an encoder, rather than being one."""
    if not inspect.isfunction(thing):
        return isinstance(thing, type)
    needed = (p for p in inspect.signature(thing).parameters.values() if p.default is p.empty)
    return all(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in needed)
