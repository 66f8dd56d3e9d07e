"""Playing stored episodes again, from their seeds and actions."""

from collections.abc import Iterator, Sequence
from itertools import chain, repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.collecting.shards import NUM_ENVS
from jbrep.dataset import Dataset, DataSettings, Episode
from jbrep.envs.environments import Environments
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Read, Recording, Tick, open_loop, read_nothing, read_states, record
from jbrep.errors import InputError
from jbrep.progress import Progress


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
    size = NUM_ENVS if is_batched(dataset.task) else 1
    read = read_states if settings.store_state else read_nothing
    with Progress(total=sum(map(len, chosen)), unit="step", unit_scale=True, leave=False) as bar:
        for first in range(0, episodes, size):
            some = chosen[first : first + size]
            recording = simulate_again(some, read, bar.update, num_threads)
            for index, episode in enumerate(some):
                if not is_equal(recording, index, episode):
                    yield (
                        f"{dataset.folder}: episode {episode.number} simulated again differs: use "
                        "the robot as it was, on the machine it was made on, with these versions: "
                        f"{dict(dataset.manifest.versions)}"
                    )


def why_not_again(settings: DataSettings) -> str:
    """Why no episode of a data set can be simulated again; empty if it can be."""
    if settings.is_imported:
        return f"they were imported from {settings.policy['source']}, so their seeds are unknown"
    if not settings.task.reproducible:
        return f"{settings.task.name} is not reproducible; collect again in another folder"
    return ""


def simulate_again(
    episodes: Sequence[Episode], read: Read, tick: Tick, num_threads: int | None = None
) -> Recording:
    """Play episodes of one data set again, each in an environment of its own."""
    dataset = episodes[0].dataset
    if dataset.manifest.settings.is_imported:
        raise InputError("imported episodes can't be simulated again")
    task = dataset.task
    middle = (np.array(task.action_low) + np.array(task.action_high)) / 2
    actions = np.tile(middle, (max(map(len, episodes)), len(episodes), 1))
    for index, episode in enumerate(episodes):
        actions[: len(episode), index] = episode["action"]
    afterwards = repeat(np.tile(middle, (len(episodes), 1)))
    with Environments(task, len(episodes), num_threads) as envs:
        envs.reset(range(len(episodes)), [int(episode.record["seed"]) for episode in episodes])
        return record(envs, open_loop(chain(actions, afterwards)), tick, read)


def is_equal(recording: Recording, index: int, episode: Episode) -> bool:
    """Whether a recorded environment went through an episode, to the last bit."""
    length, stored = len(episode), episode.record
    ends_there = recording.length[index] == length and bool(recording.terminated[index])
    if recording.length[index] < length or ends_there != bool(stored["terminated"]):
        return False
    pairs: list[tuple[Any, Any]] = []
    if not episode.dataset.manifest.settings.reward:  # or else the environment gives others
        pairs.append((recording.reward[:length, index], episode["reward"]))
    states: dict[str, NDArray[Any]] = {"observation": recording.observation, **recording.arrays}
    for name in states.keys() & episode.dataset.columns:
        values = states[name]
        pairs.append((values[:length, index], episode[name]))
        pairs.append((values[length, index], stored[f"final_{name}"]))
    for name, values in recording.start.items():
        column = f"initial_{name}" if name in episode.dataset.task.state else name
        pairs.append((values[index], stored[column]))
    return all(a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in pairs)
