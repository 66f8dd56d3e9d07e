"""Replay buffers of n agents."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.base import Float32
from jbrep.rl.presets import parameters_of
from jbrep.rl.run import Run


def capacity_of(run: Run) -> int:
    """The most transitions that a run keeps: no more than it makes, in whole rollouts."""
    chosen = run.learner.hyperparameters
    usual, _ = parameters_of(run.learner.algorithm)
    size, steps = (
        int(chosen.algorithm_kwargs.get(name, usual[name].default))
        for name in ("buffer_size", "train_freq")
    )
    rollout = steps * chosen.num_envs
    return min(size, -(-run.steps // rollout) * rollout)


def memory_of(run: Run, observed: int) -> int:
    """Bytes of a run's replay buffer, where each observation has so many numbers."""
    return 4 * capacity_of(run) * sum(_sizes(observed, run.task.action_size))


def _sizes(observation: int, action: int) -> tuple[int, ...]:
    """Numbers in the parts of a transition."""
    return observation, action, observation, 1, 1


class ReplayBuffer:
    """The last transitions of each agent, as stable-baselines3's ReplayBuffer keeps them.

    All of a transition stands in one row, so that a sample touches memory once.

    Args:
        agents: n.
        lanes: of each agent.
        capacity: transitions of each agent.
        observation: numbers in an observation.
        action: numbers in an action.

    Attributes:
        added: steps since the start.
    """

    def __init__(self, agents: int, lanes: int, capacity: int, observation: int, action: int):
        self._sizes, self.added = _sizes(observation, action), 0
        self._steps = max(capacity // lanes, 1)
        self._rows = np.empty((agents, self._steps, lanes, sum(self._sizes)), np.float32)

    @property
    def filled(self) -> int:
        """Steps that are there."""
        return min(self.added, self._steps)

    def rows_of(self, agent: int) -> Float32:
        """What is there of an agent, (filled, lanes, width); a view."""
        return self._rows[agent, : self.filled]

    def restore(self, rows: Sequence[Float32], added: int) -> None:
        """Put back what `rows_of` gave of each agent, after so many steps had been added."""
        self.added = added
        for agent, each in enumerate(rows):
            self._rows[agent, : len(each)] = each

    def add(self, *columns: Float32) -> None:
        """Add a step of each lane: observation, action, next observation, reward, terminated.

        The shapes are (n, lanes, ...).
        """
        self._rows[:, self.added % self._steps] = np.concatenate(columns, axis=2)
        self.added += 1

    def sample(self, steps: NDArray[np.int64], lanes: NDArray[np.int64]) -> list[Float32]:
        """Those that `add` was given in steps and lanes, (n, b) each; (n, b, ...) each."""
        rows = self._rows[np.arange(len(steps))[:, None], steps, lanes]
        return np.split(rows, np.cumsum(self._sizes)[:-1], axis=2)
