"""Simulating the shards of a data set, each a function of its number and the settings."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.policies import Policy
from jbrep.dataset.manifest import Manifest
from jbrep.dataset.schema import EPISODES, Columns, DataSettings
from jbrep.envs.lanes import Lanes
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Recording, Tick, read_nothing, read_states, record

LANES = 100  # of a batch
SHARD_ROWS = 20_000  # of a shard of the usual size, unless a batch makes it

Array = NDArray[Any]


@dataclass
class Missing:
    """What the shards of a manifest lack."""

    manifest: Manifest

    @property
    def rows(self) -> int:
        """How many rows, at present."""
        return self.manifest.settings.steps - self.manifest.rows

    def wants(self, shard: int) -> bool:
        """Whether a shard of that number is likely to be needed.

        Judging by the mean of the shards so far, or else by the usual size.
        """
        settings, done = self.manifest.settings, len(self.manifest.shards)
        longest = settings.shard_episodes * settings.task.max_episode_steps
        mean = self.manifest.rows / done if done else min(longest, SHARD_ROWS)
        return (shard - done) * mean < self.rows


Produce = Callable[[int, Missing, Tick], Iterator[Columns]]  # shards in order, from a number on


@dataclass(frozen=True)
class Simulator:
    """Makes the shards of a data set, each a function of its number and the settings alone.

    Attributes:
        settings: of the data set.
        policy: of the settings.
        lanes: environments of a batch, stepped at once.
        num_threads: threads to step a batch on; None takes one for each core.
    """

    settings: DataSettings
    policy: Policy
    lanes: int = LANES
    num_threads: int | None = None

    def in_turn(self, first: int, missing: Missing, tick: Tick) -> Iterator[Columns]:
        """Make one shard after the other, each with all threads."""
        for number in count(first):
            yield self.shard(number, tick, missing.rows)

    def shard(
        self, number: int, tick: Tick, rows: float = math.inf, most_episodes: int | None = None
    ) -> Columns:
        """The columns of a shard.

        It ends early once it has enough rows: what it has is the beginning of the whole shard.

        Args:
            number: of the shard.
            tick: called with the number of steps made.
            rows: how many are enough.
            most_episodes: how many of its episodes to make; None makes all.
        """
        each = self.settings.shard_episodes
        episodes = np.arange(number * each, (number + 1) * each)[:most_episodes]
        blocks = list(self._blocks(episodes, tick, rows))
        return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}

    def _blocks(self, episodes: Array, tick: Tick, rows: float) -> Iterator[Columns]:
        """The columns of the episodes, some at a time, one in each lane, until there are enough."""
        task = self.settings.task
        lanes: Lanes | None = None
        # side by side, other environments would wait for the longest episode
        size = self.lanes if is_batched(task) else 1
        while len(episodes) and rows > 0:
            needed = math.ceil(min(rows / task.max_episode_steps, len(episodes)))
            block, episodes = np.split(episodes, [min(size, needed)])
            if lanes is None or lanes.num_lanes != len(block):
                lanes = Lanes(task, len(block), self.num_threads)
            columns = self._simulate(block, lanes, tick)
            rows -= len(columns["step"])
            yield columns
        if lanes is not None:
            lanes.close()

    def _simulate(self, episodes: Array, lanes: Lanes, tick: Tick) -> Columns:
        """The columns of some episodes, one in each lane."""
        task = self.settings.task
        seeds = self.settings.seeds(episodes)
        lanes.reset(range(lanes.num_lanes), seeds.tolist())
        act = self.policy.begin(task, seeds.tolist())
        recording = record(
            lanes,
            lambda observation: act(observation).astype(np.float32),  # as it is stored
            tick,
            read_states if self.settings.store_state else read_nothing,
        )
        return self._columns(recording, episodes, seeds)

    def _columns(self, recording: Recording, episodes: Array, seeds: Array) -> Columns:
        """The columns of what was recorded, one episode after the other."""
        task, length, lanes = self.settings.task, recording.length, np.arange(len(episodes))
        seen: dict[str, Array] = {"observation": recording.observation, **recording.arrays}
        steps: dict[str, Array] = {"action": recording.action, "reward": recording.reward, **seen}
        kept = np.arange(len(recording.reward)) < length[:, None]
        known = {name: each[: kept.shape[1]].swapaxes(0, 1)[kept] for name, each in steps.items()}
        once: dict[str, Array] = {
            **{"episode": episodes, "seed": seeds, "length": length},
            **{"terminated": recording.terminated, "truncated": recording.truncated},
            **{f"initial_{name}": recording.start[name] for name in task.state},
            **{name: recording.start[name] for name in task.constants},
            **{f"final_{name}": values[length, lanes] for name, values in seen.items()},
        }
        known |= {EPISODES + name: values for name, values in once.items()}
        return self.settings.columns(known)
