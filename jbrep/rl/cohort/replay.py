"""Replay buffers of n agents."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.base import Float32
from jbrep.envs.lanes import Flags
from jbrep.rl.presets import argument
from jbrep.rl.run import Run


def capacity_of(run: Run) -> int:
    """The most transitions that a run keeps: no more than it makes, in whole rollouts."""
    chosen = run.learner.hyperparameters
    size, every = (
        argument(run.learner.algorithm, chosen, name) for name in ("buffer_size", "train_freq")
    )
    count, unit = (every, "step") if isinstance(every, int) else every
    steps = count * (chosen.agent_steps(run.task.max_episode_steps) if unit == "episode" else 1)
    rollout = steps * chosen.num_envs
    return min(size, -(-chosen.agent_steps(run.steps) // rollout) * rollout)


def memory_of(run: Run, observed: int) -> int:
    """Bytes of a run's replay buffer, where each observation has so many numbers."""
    return 4 * capacity_of(run) * sum(_sizes(observed, run.task.action_size))


def _sizes(observation: int, action: int) -> tuple[int, ...]:
    """Numbers in the parts of a transition."""
    return observation, action, observation, 1, 1, 1


class ReplayBuffer:
    """The last transitions of each agent, as stable-baselines3's ReplayBuffer keeps them.

    All of a transition stands in one row, so that a sample touches memory once.

    Args:
        agents: n.
        lanes: of each agent.
        capacity: transitions of each agent.
        observation: numbers in an observation.
        action: numbers in an action.
        n_steps: rewards that are summed, of a sample.
        gamma: by which each of them is discounted.

    Attributes:
        added: steps since the start.
    """

    def __init__(
        self,
        agents: int,
        lanes: int,
        capacity: int,
        observation: int,
        action: int,
        n_steps: int,
        gamma: float,
    ):
        self._sizes, self.added = _sizes(observation, action), 0
        self._n_steps, self._gamma = n_steps, gamma
        self._steps = max(capacity // lanes, 1)
        self._rows = np.empty((agents, self._steps, lanes, sum(self._sizes)), np.float32)

    @property
    def filled(self) -> int:
        """Steps that are there."""
        return min(self.added, self._steps)

    def rows_of(self, agent: int) -> Float32:
        """What is there of an agent, (filled, lanes, width); a view."""
        return self._rows[agent, : self.filled]

    def keep(self, agents: Sequence[int]) -> None:
        """Forget the other agents; those that are left move up, in the same memory."""
        for place, agent in enumerate(agents):
            self._rows[place] = self._rows[agent]
        self._rows = self._rows[: len(agents)]

    def restore(self, rows: Iterable[Float32], added: int) -> None:
        """Put back what `rows_of` gave of each agent, after so many steps had been added."""
        self.added = added
        for agent, each in enumerate(rows):
            self._rows[agent, : len(each)] = each

    def add(self, *columns: Float32 | Flags) -> None:
        """Add a step of each lane: observation, action, next observation, reward, flags.

        The shapes are (n, lanes, ...); flags say whether a state ended the episode, and whether it
        ended.
        """
        self._rows[:, self.added % self._steps] = np.concatenate(columns, axis=2)
        self.added += 1

    def drop(self, lost: Flags) -> None:
        """Forget the newest transition of lanes (n, lanes): the one before it ends the episode.

        That one then stands in its place, too. The first of all can't be forgotten.
        """
        if self.added > 1:
            newest, before = (self._rows[:, (self.added - k) % self._steps] for k in (1, 2))
            before[lost, -1] = 1
            newest[lost] = before[lost]

    def sample(self, steps: NDArray[np.int64], lanes: NDArray[np.int64]) -> list[Float32]:
        """Transitions of n_steps from steps and lanes, (n, b) each, as a `Batch` has them.

        One is shorter where its episode ends, or where the newest step is. Its reward is the
        discounted sum of those on the way.
        """
        agents, ahead = np.arange(len(steps))[:, None, None], np.arange(self._n_steps)
        places = (steps[..., None] + ahead) % self._steps
        rows = self._rows[agents, places, lanes[..., None]]  # (n, b, n_steps, width)
        ends = (rows[..., -1] > 0) | (places == (self.added - 1) % self._steps)
        last = np.where(ends.any(2), ends.argmax(2), len(ahead) - 1)[..., None]  # (n, b, 1)
        discounts = self._gamma ** ahead.astype(np.float32)
        reward = np.where(ahead <= last, rows[..., -3] * discounts, 0).sum(2, keepdims=True)
        discount = self._gamma ** (last + 1).astype(np.float32)
        observation, action, *_ = self._split(rows[:, :, 0])
        *_, final, _, terminated, _ = self._split(
            np.take_along_axis(rows, last[..., None], 2)[:, :, 0]
        )
        return [observation, action, final, reward, terminated, discount]

    def _split(self, rows: Float32) -> list[Float32]:
        """The parts of transitions, (n, b, ...) each."""
        return np.split(rows, np.cumsum(self._sizes)[:-1], axis=2)
