"""Reinforcement learning on a representation: one run, its files, its checkpoint."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.rl.run import Run, train

__all__ = ["Run", "train"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jbrep.rl import run  # brings torch

    return getattr(run, name)
