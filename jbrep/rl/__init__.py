"""Reinforcement learning on a representation: one run, its files, its checkpoint."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.errors import StoppedError as StoppedError
    from jbrep.rl.run import Run as Run
    from jbrep.rl.training import Session as Session
    from jbrep.rl.training import train as train

__getattr__, __dir__, __all__ = exports(__name__)  # they import torch
