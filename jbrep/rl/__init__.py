"""Reinforcement learning on a representation: one run, its files, its checkpoint."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.rl.checkpoint import StoppedError
    from jbrep.rl.run import Run
    from jbrep.rl.trainers import train

__all__ = ["Run", "StoppedError", "train"]

__getattr__, __dir__ = exports(  # which import torch
    __name__, {"Run": "run", "StoppedError": "checkpoint", "train": "trainers"}
)
