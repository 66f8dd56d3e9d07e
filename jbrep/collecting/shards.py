"""Simulating the shards of a data set, each a function of its number and the settings."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jbrep.collecting.policies import Policy
from jbrep.dataset.columns import Array
from jbrep.dataset.manifest import Manifest, commit, open_shard
from jbrep.dataset.schema import EPISODES, Columns, DataSettings, joined, some_episodes
from jbrep.dataset.settings import SHARD_ROWS
from jbrep.envs.environments import EnvironmentFailedError, Environments, Retries
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Recording, Tick, read_nothing, read_states, record
from jbrep.errors import InputError

NUM_ENVS = 100  # of a batch


class Growth:
    """A data set that lacks episodes: whole shards are written as soon as they are made.

    Attributes:
        manifest: of the full shards that are there.
        rows, episodes: how many there are, in files or held for the next one.
    """

    def __init__(self, folder: Path, manifest: Manifest):
        self.rows, self.episodes = manifest.rows, manifest.episodes
        self._folder, self._each = folder, manifest.settings.shard_episodes
        full = manifest.episodes // self._each
        begun = range(full, len(manifest.shards))  # the last one, if it isn't full
        self._held = [open_shard(folder, manifest, shard) for shard in begun]
        self.manifest = manifest.replace(shards=manifest.shards[:full])

    @property
    def lacking(self) -> int:
        """How many rows are still to be made."""
        return self.manifest.settings.steps - self.rows

    def wants(self, episode: int) -> bool:
        """Whether an episode of that number is likely to be needed.

        Judging by the mean of those that are there, or else by the usual size of a shard.
        """
        usual = min(self.manifest.task.max_episode_steps, SHARD_ROWS / self._each)
        mean = self.rows / self.episodes if self.episodes else usual
        return (episode - self.episodes) * mean < self.lacking

    def add(self, columns: Columns) -> None:
        """Take the next episodes, of one shard, as far as they are needed."""
        lengths = columns[EPISODES + "length"]
        needed = int(np.searchsorted(np.cumsum(lengths), self.lacking)) + 1
        self._held.append(some_episodes(columns, 0, needed))
        self.rows += int(lengths[:needed].sum())
        self.episodes += len(lengths[:needed])
        if self.episodes % self._each == 0 or self.lacking <= 0:
            self.manifest = commit(self._folder, self.manifest, joined(self._held))
            self._held = []


# the columns of the next episodes that a data set lacks, some of one shard at a time
Produce = Callable[[Growth, Tick], Iterator[Columns]]


@dataclass(frozen=True)
class Simulator:
    """Makes the shards of a data set, each a function of its number and the settings alone."""

    settings: DataSettings
    policy: Policy  # of the settings
    num_envs: int = NUM_ENVS  # environments of a batch, stepped at once
    num_threads: int | None = None  # to step a batch on; None takes one for each core
    retries: int = 0  # how often an episode in which the environment fails is played again

    def in_turn(self, growth: Growth, tick: Tick) -> Iterator[Columns]:
        """Make one shard after the other, each with all threads."""
        each = self.settings.shard_episodes
        while True:
            first = growth.episodes
            shard = range(first, (first // each + 1) * each)
            yield from self.made(shard, tick, lambda: growth.lacking)

    def made(
        self, shard: range, tick: Tick, wanted: Callable[[], float] = lambda: math.inf
    ) -> Iterator[Columns]:
        """The columns of episodes of a shard, some at a time, while rows are wanted."""
        episodes = np.array(shard)
        longest, retries = self.settings.task.max_episode_steps, Retries(self.retries)
        # one in each environment; those that aren't a batch would wait for the longest episode
        most = self.num_envs if is_batched(self.settings.task) else 1

        def at_once() -> int:
            return min(most, math.ceil(min(wanted() / longest, len(episodes))))

        has_failed = False
        while (size := at_once()) > 0:
            try:
                with Environments(self.settings.task, size, self.num_threads) as envs:
                    while at_once() == size:
                        columns = self._simulate(episodes[:size], envs, tick)
                        retries.succeeded()
                        episodes = episodes[size:]
                        yield columns
            except InputError as error:
                if not (has_failed or isinstance(error, EnvironmentFailedError)):
                    raise  # it could never be made
                has_failed = True
                retries.failed(error)

    def _simulate(self, episodes: Array, envs: Environments, tick: Tick) -> Columns:
        task = self.settings.task
        seeds = self.settings.seeds(episodes)
        envs.reset(range(envs.num_envs), seeds.tolist())
        act = self.policy.begin(task, seeds.tolist())
        recording = record(
            envs,
            lambda observation: act(observation).astype(np.float32),  # as it is stored
            tick,
            read_states if self.settings.store_state else read_nothing,
        )
        return self._columns(recording, episodes, seeds)

    def _columns(self, recording: Recording, episodes: Array, seeds: Array) -> Columns:
        task, length, indices = self.settings.task, recording.length, np.arange(len(episodes))
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
            **{f"final_{name}": values[length, indices] for name, values in seen.items()},
        }
        known |= {EPISODES + name: values for name, values in once.items()}
        return self.settings.columns(known)
