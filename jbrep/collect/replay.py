"""Playing stored episodes again, from their seeds and actions."""

from collections.abc import Iterator, Sequence
from itertools import chain, repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset, Episode
from jbrep.envs.lanes import Lanes
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Read, Recording, Tick, open_loop, read_nothing, read_states, record
from jbrep.errors import InputError
from jbrep.progress import Progress

_LANES = 100


def replay_problems(
    dataset: Dataset, episodes: int, num_threads: int | None = None
) -> Iterator[str]:
    """Play some episodes again and compare every bit.

    Args:
        dataset: with the episodes.
        episodes: how many; they are drawn at random, always the same ones.
        num_threads: threads to step a batch on; None takes one for each core.

    Yields:
        A line for each episode that differs.
    """
    total = len(dataset.episodes["length"])
    if not 0 <= episodes <= total:
        raise InputError(f"{episodes} episodes can't be replayed: the data set has {total:,}")
    if not episodes:
        return  # without a look at the environment, whose package need not be there
    if dataset.manifest.settings.is_imported:
        raise InputError(
            f"{dataset.folder} was imported: to compare it with its source, import that again in "
            "another folder"
        )
    if not dataset.task.reproducible:
        raise InputError(
            f"episodes can't be replayed: {dataset.task.name} is not reproducible, the same seed "
            "and actions lead to other states"
        )
    numbers = np.sort(np.random.default_rng(0).permutation(total)[:episodes])
    chosen = [dataset.episode(int(number)) for number in numbers]
    steps = sum(map(len, chosen))
    lanes = _LANES if is_batched(dataset.task) else 1
    with Progress(total=steps, unit="step", unit_scale=True, leave=False) as bar:
        for first in range(0, episodes, lanes):
            some = chosen[first : first + lanes]
            read = read_states if dataset.manifest.settings.store_state else read_nothing
            recording = simulate_again(some, read, bar.update, num_threads)
            for lane, episode in enumerate(some):
                if not _is_equal(recording, lane, episode):
                    yield (
                        f"{dataset.folder}: episode {episode.number} simulated again differs: has "
                        "the robot changed, or is this another machine, or other versions than "
                        f"{dict(dataset.manifest.versions)}?"
                    )


def simulate_again(
    episodes: Sequence[Episode], read: Read, tick: Tick, num_threads: int | None = None
) -> Recording:
    """Play stored episodes again, one in each lane; after its last action a lane gets others.

    Args:
        episodes: of one data set, at least one.
        read: what to record besides observations and rewards.
        tick: called after each step.
        num_threads: threads to step a batch on; None takes one for each core.
    """
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
    """Whether a lane went through what is stored of an episode, to the last bit."""
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
