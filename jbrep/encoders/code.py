"""Encoders that are code: named as module:Class, once the module has been imported on request."""

import inspect
from pathlib import Path
from typing import Any

from jbrep.encoders.base import BaseEncoder, as_encoder
from jbrep.envs.names import code_named
from jbrep.envs.task import Task
from jbrep.errors import refusing


def make(name: str | Path, task: Task) -> BaseEncoder:
    """The encoder that code names: a class, or a function of no arguments, is called to make it."""
    with refusing(f"can't make the encoder {name}"):
        thing = code_named(str(name), "encoder")
        if _makes(thing):
            thing = thing()
    return as_encoder(thing, task)


def _makes(thing: Any) -> bool:
    """Whether it makes an encoder, rather than being one."""
    if not inspect.isfunction(thing):
        return isinstance(thing, type)
    needed = (p for p in inspect.signature(thing).parameters.values() if p.default is p.empty)
    return all(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in needed)
