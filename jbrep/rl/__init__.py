"""Reinforcement learning on a representation: one run, its files, its checkpoint."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.rl.checkpoint import StoppedError
    from jbrep.rl.run import Run
    from jbrep.rl.trainers import train

__all__ = ["Run", "StoppedError", "train"]

_MODULES = {"Run": "run", "StoppedError": "checkpoint", "train": "trainers"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)  # imports torch
