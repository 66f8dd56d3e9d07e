"""Simulating the shards of a data set, each a function of its number and the settings."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.policies import Policy
from jbrep.dataset.manifest import Manifest
from jbrep.dataset.schema import EPISODES, Columns, DataSettings, joined
from jbrep.envs.lanes import EnvironmentFailedError, Lanes, Retries
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Recording, Tick, read_nothing, read_states, record
from jbrep.errors import InputError

LANES = 100  # of a batch
SHARD_ROWS = 20_000  # of a shard of the usual size, unless a batch makes it

Array = NDArray[Any]


@dataclass
class Remaining:
    """What the shards of a manifest still lack.

    Attributes:
        manifest: of what is committed.
        held: rows that were made since.
    """

    manifest: Manifest
    held: int = 0

    @property
    def rows(self) -> int:
        """How many rows, at present."""
        return self.manifest.settings.steps - self.manifest.rows - self.held

    def begun(self, shard: int) -> int:
        """How many episodes of a shard are committed."""
        each = self.manifest.settings.shard_episodes
        return min(max(self.manifest.episodes - shard * each, 0), each)

    def wants(self, episode: int) -> bool:
        """Whether an episode of that number is likely to be needed.

        Judging by the mean of those that are committed, or else by the usual size of a shard.
        """
        manifest, settings = self.manifest, self.manifest.settings
        usual = min(settings.task.max_episode_steps, SHARD_ROWS / settings.shard_episodes)
        mean = manifest.rows / manifest.episodes if manifest.episodes else usual
        return (episode - manifest.episodes) * mean < settings.steps - manifest.rows


# the columns of episodes in order, from the shard of a number on, some of one shard at a time;
# episodes that are committed already may be left out
Produce = Callable[[int, Remaining, Tick], Iterator[Columns]]


class Made(NamedTuple):
    """What became of some episodes."""

    columns: Columns | None  # of those before a failure; None if there are none
    failure: str = ""


def all_of(made: Made) -> Iterator[Columns]:
    """What was made, and then the failure."""
    if made.columns is not None:
        yield made.columns
    if made.failure:
        raise InputError(made.failure)


@dataclass(frozen=True)
class Simulator:
    """Makes the shards of a data set, each a function of its number and the settings alone.

    Attributes:
        settings: of the data set.
        policy: of the settings.
        lanes: environments of a batch, stepped at once.
        num_threads: threads to step a batch on; None takes one for each core.
        retries: how often an episode in which the environment fails is played again.
    """

    settings: DataSettings
    policy: Policy
    lanes: int = LANES
    num_threads: int | None = None
    retries: int = 0

    def in_turn(self, first: int, remaining: Remaining, tick: Tick) -> Iterator[Columns]:
        """Make one shard after the other, each with all threads."""
        for number in count(first):
            episodes = self._episodes(number)[remaining.begun(number) :]
            yield from self._blocks(episodes, tick, lambda: remaining.rows)

    def _episodes(self, shard: int) -> Array:
        each = self.settings.shard_episodes
        return np.arange(shard * each, (shard + 1) * each)

    def made(self, episodes: range, tick: Tick) -> Made:
        """Some episodes of a shard."""
        blocks, failure = list[Columns](), ""
        try:
            for block in self._blocks(np.array(episodes), tick, lambda: math.inf):
                blocks.append(block)
        except InputError as error:
            failure = str(error)
        return Made(joined(blocks) if blocks else None, failure)

    def shard(self, number: int, tick: Tick, most_episodes: int | None = None) -> Columns:
        """The columns of a shard.

        Args:
            number: of the shard.
            tick: called with the number of steps made.
            most_episodes: how many of its episodes to make; None makes all.
        """
        episodes = self._episodes(number)[:most_episodes]
        return joined(list(self._blocks(episodes, tick, lambda: math.inf)))

    def _blocks(
        self, episodes: Array, tick: Tick, wanted: Callable[[], float]
    ) -> Iterator[Columns]:
        """The columns of the episodes, some at a time, one in each lane, while rows are wanted."""
        longest, retries = self.settings.task.max_episode_steps, Retries(self.retries)
        # side by side, other environments would wait for the longest episode
        most = self.lanes if is_batched(self.settings.task) else 1

        def at_once() -> int:
            return min(most, math.ceil(min(wanted() / longest, len(episodes))))

        has_failed = False
        while (size := at_once()) > 0:
            try:
                with Lanes(self.settings.task, size, self.num_threads) as lanes:
                    while at_once() == size:
                        columns = self._simulate(episodes[:size], lanes, tick)
                        retries.succeeded()
                        episodes = episodes[size:]
                        yield columns
            except InputError as error:
                if not (has_failed or isinstance(error, EnvironmentFailedError)):
                    raise  # it could never be made
                has_failed = True
                retries.failed(error)

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
            "missing": recording.missing,
            **{f"initial_{name}": recording.start[name] for name in task.state},
            **{name: recording.start[name] for name in task.constants},
            **{f"final_{name}": values[length, lanes] for name, values in seen.items()},
        }
        known |= {EPISODES + name: values for name, values in once.items()}
        return self.settings.columns(known)
