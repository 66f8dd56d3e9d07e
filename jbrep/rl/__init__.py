"""Reinforcement learning on a representation: one run, its files, its checkpoint."""

from jbrep.rl.run import Run, train

__all__ = ["Run", "train"]
