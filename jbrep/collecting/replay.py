"""Playing stored episodes again, from their seeds and actions, and making damaged shards again."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.collecting.policies import Policy, make_policy
from jbrep.collecting.shards import LANES, Simulator
from jbrep.dataset import Dataset, DataSettings, Episode
from jbrep.dataset.manifest import (
    Manifest,
    open_shard,
    policy_files,
    read_manifest,
    shard_image,
    shard_path,
)
from jbrep.dataset.schema import joined
from jbrep.envs.lanes import Lanes, check_counts
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Read, Recording, Tick, open_loop, read_nothing, read_states, record
from jbrep.errors import DamageError, InputError
from jbrep.progress import Progress
from jbrep.records.storage import exclusive, write_whole


def replay_problems(
    dataset: Dataset, episodes: int, num_threads: int | None = None
) -> Iterator[str]:
    """Play so many episodes again; yields a line for each that differs in a bit.

    They are drawn at random, always the same ones.
    """
    total, settings = len(dataset.episodes["length"]), dataset.manifest.settings
    if not 0 <= episodes <= total:
        raise InputError(f"{episodes} episodes can't be replayed: the data set has {total:,}")
    if not episodes:
        return  # without a look at the environment, whose package need not be there
    if reason := why_not_again(settings):
        raise InputError(f"episodes of {dataset.folder} can't be replayed: {reason}")
    numbers = np.sort(np.random.default_rng(0).permutation(total)[:episodes])
    chosen = [dataset.episode(int(number)) for number in numbers]
    lanes = LANES if is_batched(dataset.task) else 1
    read = read_states if settings.store_state else read_nothing
    with Progress(total=sum(map(len, chosen)), unit="step", unit_scale=True, leave=False) as bar:
        for first in range(0, episodes, lanes):
            some = chosen[first : first + lanes]
            recording = simulate_again(some, read, bar.update, num_threads)
            for lane, episode in enumerate(some):
                if not _is_equal(recording, lane, episode):
                    what = f"{dataset.folder}: episode {episode.number} simulated again differs"
                    yield f"{what}: {why_otherwise(dataset.manifest)}"


def why_not_again(settings: DataSettings) -> str:
    """Why no episode of a data set can be simulated again; empty if it can be."""
    if settings.is_imported:
        source = settings.policy["source"]
        return f"they were imported; import their source, {source}, again in another folder"
    if not settings.task.reproducible:
        return f"{settings.task.name} is not reproducible; collect again in another folder"
    return ""


def why_otherwise(manifest: Manifest) -> str:
    """Why an episode may come out differently."""
    return (
        "use the robot as it was, on the machine it was made on, with these versions: "
        f"{dict(manifest.versions)}"
    )


def simulate_again(
    episodes: Sequence[Episode], read: Read, tick: Tick, num_threads: int | None = None
) -> Recording:
    """Play episodes of one data set again, one in each lane, which then gets other actions."""
    dataset = episodes[0].dataset
    if dataset.manifest.settings.is_imported:
        raise InputError("imported episodes can't be simulated again")
    task = dataset.task
    middle = (np.array(task.action_low) + np.array(task.action_high)) / 2
    actions = np.tile(middle, (max(map(len, episodes)), len(episodes), 1))
    for lane, episode in enumerate(episodes):
        actions[: len(episode), lane] = episode["action"]
    afterwards = repeat(np.tile(middle, (len(episodes), 1)))
    with Lanes(task, len(episodes), num_threads) as lanes:
        lanes.reset(range(len(episodes)), [int(episode.record["seed"]) for episode in episodes])
        return record(lanes, open_loop(chain(actions, afterwards)), tick, read)


def _is_equal(recording: Recording, lane: int, episode: Episode) -> bool:
    length, stored = len(episode), episode.record
    ends_there = recording.length[lane] == length and bool(recording.terminated[lane])
    if recording.length[lane] < length or ends_there != bool(stored["terminated"]):
        return False
    pairs: list[tuple[Any, Any]] = []
    if not episode.dataset.manifest.settings.reward:  # or else the environment gives others
        pairs.append((recording.reward[:length, lane], episode["reward"]))
    states: dict[str, NDArray[Any]] = {"observation": recording.observation, **recording.arrays}
    for name, values in states.items():
        pairs.append((values[:length, lane], episode[name]))
        pairs.append((values[length, lane], stored[f"final_{name}"]))
    for name, values in recording.start.items():
        column = f"initial_{name}" if name in episode.dataset.task.state else name
        pairs.append((values[lane], stored[column]))
    return all(a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in pairs)


def repair(
    folder: Path,
    lanes: int = LANES,
    num_threads: int | None = None,
    make: Callable[[Mapping[str, Any]], Policy] = make_policy,
) -> Iterator[str]:
    """Make damaged and missing shards again from their seeds; yields a line for each.

    The policy is made from what the manifest says of it.
    """
    check_counts(lanes, num_threads)
    read_manifest(folder)  # so that nothing is locked that isn't a data set
    with exclusive(folder):
        manifest = read_manifest(folder)
        settings = manifest.settings
        for shard in range(len(manifest.shards)):
            try:
                open_shard(folder, manifest, shard)
            except DamageError:
                path = shard_path(folder, shard)
                reason = why_not_again(settings)
                if settings.reward:
                    reason = f"{settings.reward} gave the rewards; derive them again elsewhere"
                if reason:
                    raise InputError(f"{path} can't be restored: {reason}") from None
                simulator = Simulator(settings, make(settings.policy), lanes, num_threads)
                write_whole(path, _image(simulator, manifest, shard, path))
                yield f"{path} restored"
        policy_files(folder, manifest)


def _image(simulator: Simulator, manifest: Manifest, shard: int, path: Path) -> bytes:
    entry, task = manifest.shards[shard], manifest.task
    first = shard * manifest.settings.shard_episodes
    with Progress(total=entry.rows, unit="step", unit_scale=True, desc=path.name) as progress:
        try:
            episodes = range(first, first + entry.episodes)
            blocks = [*simulator.made(episodes, progress.update)]
        except InputError as error:
            again = "; derive the data set again in another folder" if task.view else ""
            raise InputError(f"{path} can't be restored: {error}{again}") from None
    made, image = shard_image(manifest, shard, joined(blocks))
    if made != entry:
        why = why_otherwise(manifest)
        raise InputError(f"{path} can't be restored here: it comes out differently; {why}")
    return image
