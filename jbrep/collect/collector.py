"""The collector: a policy in many episodes, written to the shards of a data set."""

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.policies import Policy, make_policy, policy_settings
from jbrep.dataset.manifest import (
    MANIFEST,
    Manifest,
    check_files,
    commit,
    hdf5_files,
    new_manifest,
    read_manifest,
    write_manifest,
)
from jbrep.dataset.schema import EPISODES, Columns, all_specs, episode_returns, episode_seed
from jbrep.dataset.settings import Settings
from jbrep.envs.checks import check_counts
from jbrep.envs.lanes import Lanes
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Recording, Tick, read_nothing, read_states, record
from jbrep.errors import InputError, differences
from jbrep.files.lock import exclusive
from jbrep.files.storage import check_space, exists, make_folder
from jbrep.progress import Progress

LANES = 100  # of a batch
_MAX_SHARDS = 10_000
_BATCH_ROWS, _SHARD_ROWS = 100_000, 20_000  # of a shard
_PILOT = 10  # episodes

Array = NDArray[Any]


class Missing(Protocol):
    """What a data set still lacks."""

    @property
    def rows(self) -> int:
        """How many rows, at present."""

    def wants(self, shard: int) -> bool:
        """Whether a shard of that number is likely to be needed."""


Produce = Callable[[int, Missing, Tick], Iterator[Columns]]  # shards in order, from a number on


class Written(NamedTuple):
    """What a call has done."""

    manifest: Manifest
    rows: int  # written by this call
    seconds: float


def collect(
    settings: Settings,
    folder: Path,
    lanes: int = LANES,
    num_threads: int | None = None,
    backend: str = "local",
) -> Written:
    """Collect a data set, or what is missing of it.

    Neither lanes, threads nor backend change a byte.

    Args:
        settings: what to collect.
        folder: new, or with an unfinished data set of the same settings.
        lanes: environments of a batch, stepped at once.
        num_threads: threads of a batch, or processes of other environments; None takes one for
            each core.
        backend: local, or ray for a cluster.

    Raises:
        InputError: invalid settings, a data set of other settings in the folder, a shard that is
            missing or damaged, too little disk space, or an environment that fails.
    """
    from jbrep.collect.backends import get_backend

    policy = make_policy(settings.policy)
    policy.begin(settings.task, [0])  # may refuse the task
    settings = replace(settings, policy=policy_settings(policy))
    check_counts(lanes, num_threads)
    return write_shards(settings, folder, get_backend(backend)(settings, lanes, num_threads))


def write_shards(settings: Settings, folder: Path, produce: Produce) -> Written:
    """Commit the missing shards, until there are as many rows as the settings ask for.

    Args:
        settings: of the data set.
        folder: of the data set.
        produce: makes shards, one after the other; of the last, only the episodes that are needed
            are kept.

    Raises:
        InputError: as `collect` does.
    """
    began = time.monotonic()
    make_folder(folder)
    with exclusive(folder):
        manifest = _begin(settings, folder)
        before = manifest.rows
        if not manifest.complete:
            with Progress(
                total=settings.steps, initial=before, unit="step", unit_scale=True, desc=folder.name
            ) as progress:
                manifest = _fill(folder, manifest, produce, progress)
    return Written(manifest, manifest.rows - before, time.monotonic() - began)


def _fill(folder: Path, manifest: Manifest, produce: Produce, progress: Any) -> Manifest:
    missing = _Missing(manifest)
    shards = produce(len(manifest.shards), missing, progress.update)
    try:
        for columns in shards:
            manifest = commit(folder, manifest, _cut(columns, missing.rows))
            missing.manifest = manifest
            progress.update(manifest.rows - progress.n)
            size = sum(entry.bytes for entry in manifest.shards)
            progress.set_postfix_str(f"{size / 1e6:,.0f} MB on disk")
            if manifest.complete:
                break
            if len(manifest.shards) == _MAX_SHARDS:
                raise InputError(
                    f"{folder} has {_MAX_SHARDS:,} shards, which is the limit: put more than "
                    f"{manifest.settings.shard_episodes:,} episodes in a shard, in another folder"
                )
    finally:
        if isinstance(shards, Generator):
            shards.close()
    return manifest


class _Missing:
    """What a manifest's shards lack."""

    def __init__(self, manifest: Manifest):
        self.manifest = manifest

    @property
    def rows(self) -> int:
        return self.manifest.settings.steps - self.manifest.rows

    def wants(self, shard: int) -> bool:
        """Judging by the mean of the shards so far."""
        settings, done = self.manifest.settings, len(self.manifest.shards)
        longest = settings.shard_episodes * settings.task.max_episode_steps
        mean = self.manifest.rows / done if done else longest
        return (shard - done) * mean < self.rows


def _cut(columns: Columns, rows: int) -> Columns:
    """The fewest whole episodes of a shard that have as many rows; all if there are fewer."""
    ends = np.cumsum(columns[EPISODES + "length"])
    episodes = int(np.searchsorted(ends, rows)) + 1
    rows = int(ends[min(episodes, len(ends)) - 1])
    return {
        name: values[: episodes if name.startswith(EPISODES) else rows]
        for name, values in columns.items()
    }


def _begin(settings: Settings, folder: Path) -> Manifest:
    """The manifest to resume from, new if there is none."""
    files = hdf5_files(folder)
    if (folder / MANIFEST).exists() or files:
        manifest = read_manifest(folder)
        _check_same(manifest, new_manifest(settings), folder)
        check_files(folder, manifest, files)
    else:
        manifest = new_manifest(settings)
        check_space(folder, settings.steps * settings.row_bytes())
        write_manifest(folder, manifest)
    return manifest


def _check_same(there: Manifest, wanted: Manifest, folder: Path) -> None:
    """Check that resuming gives what an uninterrupted run gives."""
    differing = differences(_flat(there.settings), _flat(wanted.settings))
    if differing:
        raise InputError(
            f"{folder} holds a data set with other settings: {differing}; "
            "choose another folder, or the same settings to resume"
        )
    differing = differences(
        {**there.versions, "format": there.format_version},
        {**wanted.versions, "format": wanted.format_version},
    )
    if differing and not there.complete:
        raise InputError(
            f"{folder} was started with other versions: {differing}; "
            "install those to resume, or choose another folder"
        )


def _flat(settings: Settings) -> dict[str, Any]:
    """The settings with those of the environment beside them; equal names mean equal features.

    Whether it terminates is left out: it is what was seen of some episodes.
    """
    others = ("id", "name", "terminates")
    task = {n: v for n, v in settings.task.as_json().items() if n not in others}
    return {n: v for n, v in settings.as_json().items() if n != "environment"} | task


def usual_shard_episodes(settings: Settings, folder: Path) -> int:
    """Episodes in a shard of the usual size, judging by the data set's first few.

    A batch's shards have 100,000 steps, each with all threads; other environments' 20,000, since
    they are made side by side. A data set that is there already keeps its own number.

    Raises:
        InputError: the manifest in the folder can't be read.
    """
    if exists(folder / MANIFEST):
        return read_manifest(folder).settings.shard_episodes
    task = settings.task
    length = float(task.max_episode_steps)
    if task.terminates is not False:
        policy = make_policy(settings.policy)
        pilot = replace(settings, shard_episodes=_PILOT)
        columns = simulate_shard(pilot, policy, 0, lambda steps: None)
        length = columns[EPISODES + "length"].mean()
    return max(1, round((_BATCH_ROWS if is_batched(task) else _SHARD_ROWS) / length))


def shards_in_turn(settings: Settings, lanes: int, num_threads: int | None) -> Produce:
    """Make one shard after the other, each with all threads."""
    policy = make_policy(settings.policy)

    def produce(first: int, missing: Missing, tick: Tick) -> Iterator[Columns]:
        for shard in count(first):
            rows = missing.rows
            yield simulate_shard(settings, policy, shard, tick, lanes, num_threads, rows)

    return produce


def simulate_shard(
    settings: Settings,
    policy: Policy,
    shard: int,
    tick: Tick,
    lanes: int = LANES,
    num_threads: int | None = None,
    rows: float = math.inf,
    most_episodes: int | None = None,
) -> Columns:
    """The columns of a shard: a function of its number and the settings only.

    It ends early once it has enough rows: what it has is the beginning of the whole shard.

    Args:
        settings: of the data set.
        policy: of the settings.
        shard: its number.
        tick: called with the number of steps made.
        lanes: environments of a batch, stepped at once.
        num_threads: threads to step a batch on; None takes one for each core.
        rows: how many are enough.
        most_episodes: how many of its episodes to make; None makes all.
    """
    first = shard * settings.shard_episodes
    episodes = np.arange(first, first + settings.shard_episodes)[:most_episodes]
    size = _lanes_in_block(settings, lanes)
    blocks = list(_blocks(settings, policy, episodes, size, tick, num_threads, rows))
    specs = all_specs(settings.task, settings.store_state)
    return {name: np.concatenate([block[name] for block in blocks]) for name in specs}


def _lanes_in_block(settings: Settings, lanes: int) -> int:
    """Episodes played side by side: those that would wait for the longest one cost time."""
    if not is_batched(settings.task):
        return 1
    return max(1, min(lanes, settings.shard_episodes))


def _blocks(
    settings: Settings,
    policy: Policy,
    episodes: Array,
    size: int,
    tick: Tick,
    num_threads: int | None,
    rows: float,
) -> Iterator[Columns]:
    """The columns of the episodes, some at a time, one in each lane, until there are enough."""
    lanes: Lanes | None = None
    while len(episodes) and rows > 0:
        needed = math.ceil(min(rows / settings.task.max_episode_steps, len(episodes)))
        block, episodes = np.split(episodes, [min(size, needed)])
        if lanes is None or lanes.num_lanes != len(block):
            lanes = Lanes(settings.task, len(block), num_threads)
        columns = _simulate(settings, policy, block, lanes, tick)
        rows -= len(columns["step"])
        yield columns
    if lanes is not None:
        lanes.close()


def _simulate(
    settings: Settings, policy: Policy, episodes: Array, lanes: Lanes, tick: Tick
) -> Columns:
    """The columns of some episodes, one in each lane."""
    task = settings.task
    seeds = [episode_seed(task, settings.seed, int(episode)) for episode in episodes]
    lanes.reset(range(lanes.num_lanes), seeds)
    act = policy.begin(task, seeds)
    recording = record(
        lanes,
        lambda observation: act(observation).astype(np.float32),  # as it is stored
        tick,
        read_states if settings.store_state else read_nothing,
    )
    rows = _rows(recording, episodes)
    return rows | {
        EPISODES + name: column
        for name, column in _ends(settings, recording, episodes, seeds, rows["reward"])
    }


def _rows(recording: Recording, episodes: Array) -> dict[str, Array]:
    """Columns with a row for each step, one episode after the other."""
    steps = len(recording.reward)
    step = np.arange(steps, dtype=np.int32)
    kept = step < recording.length[:, None]
    values: dict[str, Array] = {
        "observation": recording.observation,
        **recording.arrays,
        "action": recording.action.astype(np.float32),
        "reward": recording.reward,
    }
    rows: dict[str, Array] = {
        "episode": np.repeat(episodes.astype(np.int32), recording.length),
        "step": np.broadcast_to(step, kept.shape)[kept],
    }
    return rows | {name: each[:steps].swapaxes(0, 1)[kept] for name, each in values.items()}


def _ends(
    settings: Settings,
    recording: Recording,
    episodes: Array,
    seeds: Sequence[int],
    reward: Array,
) -> Iterator[tuple[str, Array]]:
    """Columns with a row for each episode; the reward is the column with a row for each step."""
    length, task = recording.length, settings.task
    yield "episode", episodes.astype(np.int32)
    yield "seed", np.array(seeds, np.int64)
    yield "length", length
    yield "return", episode_returns(reward, length)
    yield "terminated", recording.terminated.astype(np.uint8)
    yield "truncated", recording.truncated.astype(np.uint8)
    yield from ((f"initial_{name}", recording.start[name]) for name in task.state)
    yield from ((name, recording.start[name]) for name in task.constants)
    lanes = np.arange(len(episodes))
    final: dict[str, Array] = {"observation": recording.observation, **recording.arrays}
    yield from ((f"final_{name}", values[length, lanes]) for name, values in final.items())
