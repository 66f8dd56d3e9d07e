"""Replay memory of n agents."""

import inspect
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from jbrep.rl.cohort.steps import Batch
from jbrep.rl.presets import ALGORITHMS
from jbrep.rl.run import Run

Float32 = NDArray[np.float32]


def capacity_of(run: Run) -> int:
    """The most transitions that a run remembers: no more than it makes, in whole rollouts."""
    usual = inspect.signature(ALGORITHMS[run.algorithm]).parameters
    size, steps = (
        int(run.used.settings.get(name, usual[name].default))
        for name in ("buffer_size", "train_freq")
    )
    rollout = steps * run.used.num_envs
    return min(size, -(-run.steps // rollout) * rollout)


def memory_of(run: Run, observed: int) -> int:
    """Bytes of a run's replay memory, where each observation has so many numbers."""
    return 4 * capacity_of(run) * sum(_sizes(observed, run.task.action_size))


def _sizes(observation: int, action: int) -> tuple[int, ...]:
    """Numbers in the parts of a transition."""
    return observation, action, observation, 1, 1


class Replay:
    """The last transitions of each member, as stable-baselines3's ReplayBuffer keeps them.

    All of a transition stands in one row, so that a sample touches memory once.

    Args:
        members: n.
        lanes: of each member.
        capacity: transitions of each member.
        observation: numbers in an observation.
        action: numbers in an action.

    Attributes:
        added: steps since the start.
    """

    def __init__(self, members: int, lanes: int, capacity: int, observation: int, action: int):
        self._sizes = _sizes(observation, action)
        self._steps = max(capacity // lanes, 1)
        self._rows = np.empty((members, self._steps, lanes, sum(self._sizes)), np.float32)
        self.added = 0

    @property
    def filled(self) -> int:
        """Steps that are there."""
        return min(self.added, self._steps)

    def of(self, member: int) -> Float32:
        """What is there of a member, (filled, lanes, width); a view."""
        return self._rows[member, : self.filled]

    def refill(self, rows: Sequence[Float32], added: int) -> None:
        """Put back what `of` gave of each member.

        Args:
            rows: of each member.
            added: steps that had been added.
        """
        self.added = added
        for member, each in enumerate(rows):
            self._rows[member, : len(each)] = each

    def add(self, *columns: Float32) -> None:
        """Add a step of each lane: observation, action, next observation, reward, ended.

        The shapes are (n, lanes, ...).
        """
        self._rows[:, self.added % self._steps] = np.concatenate(columns, axis=2)
        self.added += 1

    def sample(
        self,
        rows: NDArray[np.int64],
        lanes: NDArray[np.int64],
        show: Callable[[Float32], Float32],
    ) -> Batch:
        """The transitions of those steps and lanes, (n, b) each.

        Args:
            rows: the steps.
            lanes: the lanes.
            show: observations (n, b, size) as agents see them now.
        """
        taken = self._rows[np.arange(len(rows))[:, None], rows, lanes]
        seen, action, after, reward, ended = np.split(taken, np.cumsum(self._sizes)[:-1], axis=2)
        return Batch(*map(torch.from_numpy, (show(seen), action, show(after), reward, ended)))
