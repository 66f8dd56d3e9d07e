"""Lanes that never stop: where an episode ends, the next one begins."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jbrep.envs.lanes import Flags, Lanes, State
from jbrep.envs.task import Array, Task


class Moved(NamedTuple):
    """What a step of n lanes led to."""

    observation: Array  # (n, d); the first of the next episode where one ended
    final: Array  # (n, d); the last one of the episode that ended, else the same
    reward: Array  # (n,)
    ended: Flags  # (n,)
    terminated: Flags  # (n,) whether a state ended it
    non_finite: Flags | None  # (n,) whether the physics diverged, where the environment says so

    @property
    def diverged(self) -> Flags:
        """Whether the physics is known to have diverged, (n,)."""
        return np.zeros_like(self.ended) if self.non_finite is None else self.non_finite

    def told(self, lane: int) -> dict[str, bool]:
        """What an environment says of the end of a lane's episode, by its own names."""
        return {} if self.non_finite is None else {"non_finite": bool(self.non_finite[lane])}


class Endless:
    """Lanes whose episodes follow one another.

    The first episode of a lane has the lane's seed, as in a Gymnasium environment; episode k from 1
    on has a number below 2^31 drawn from that seed and k, so that each can be played again by
    itself.

    Args:
        task: whose environment is made.
        num_lanes: n.
        num_threads: as for `Lanes`.

    Attributes:
        lanes: the episodes under way.
    """

    def __init__(self, task: Task, num_lanes: int, num_threads: int | None = None):
        self.lanes = Lanes(task, num_lanes, num_threads)
        self._seeds = np.zeros(num_lanes, np.int64)
        self._episodes = np.zeros(num_lanes, np.int64)  # k of each lane's episode

    def reset(self, seeds: Sequence[int | None]) -> Array:
        """Start the first episode of a lane's new seed, or its next one; observations (n, d)."""
        self._episodes += 1
        for lane, seed in enumerate(seeds):
            if seed is not None:
                self._seeds[lane], self._episodes[lane] = seed, 0
        return self._start(range(self.lanes.num_lanes))

    def step(self, actions: Array) -> Moved:
        """Take a step in every lane; actions (n, k).

        Raises:
            InputError, NonFiniteActionError, EnvironmentFailedError: as `Lanes.step`.
        """
        step, ended = self.lanes.step(actions), self.lanes.ended
        observation, non_finite = step.observation, self.lanes.info.get("non_finite")
        if ended.any():
            numbers = np.flatnonzero(ended).tolist()
            self._episodes[numbers] += 1
            observation = self._start(numbers)
        final, reward, terminated = step.observation, step.reward, step.terminated
        return Moved(observation, final, reward, ended, terminated, non_finite)

    @property
    def state(self) -> State:
        """A copy of what `restore` takes: everything that decides how the lanes continue."""
        own = {"first_seeds": self._seeds.copy(), "episodes": self._episodes.copy()}
        return own | self.lanes.state

    def restore(self, state: State) -> None:
        """Continue from where the state was taken, to the same bits.

        Raises:
            InputError: the environment isn't reproducible.
        """
        lanes = dict(state)
        self._seeds, self._episodes = lanes.pop("first_seeds"), lanes.pop("episodes")
        self.lanes.restore(lanes)

    def _start(self, lanes: Sequence[int]) -> Array:
        seeds = [_episode_seed(int(self._seeds[i]), int(self._episodes[i])) for i in lanes]
        return self.lanes.reset(lanes, seeds)


def _episode_seed(first: int, episode: int) -> int:
    """The seed of a lane's episode, from that of its first and the number of episodes before."""
    if episode == 0:
        return first
    return int(np.random.SeedSequence([first, episode]).generate_state(1)[0]) >> 1
