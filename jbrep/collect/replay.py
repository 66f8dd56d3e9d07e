"""Simulating stored episodes again, from their starts and actions."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset, Episode
from jbrep.dataset.schema import STATE_COLUMNS
from jbrep.errors import InputError
from jbrep.jitterbug.episodes import Recording, Tick, open_loop, record
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import EPISODE_STEPS
from jbrep.progress import Progress

_LANES = 100


def replay_problems(
    dataset: Dataset, episodes: int, num_threads: int | None = None
) -> Iterator[str]:
    """Simulate some episodes again and compare every bit.

    Args:
        dataset: with the episodes.
        episodes: how many; they are drawn at random, always the same ones.
        num_threads: threads to simulate on; None takes one for each core.

    Yields:
        A line for each episode that differs.

    Raises:
        InputError: there are fewer episodes.
    """
    total = len(dataset.episodes["length"])
    if not 0 <= episodes <= total:
        raise InputError(f"{episodes} episodes can't be replayed: the data set has {total:,}")
    numbers = np.sort(np.random.default_rng(0).permutation(total)[:episodes])
    chosen = [dataset.episode(int(number)) for number in numbers]
    with Progress(total=episodes * EPISODE_STEPS, unit="step", unit_scale=True, leave=False) as bar:
        for first in range(0, episodes, _LANES):
            some = chosen[first : first + _LANES]
            names = [name for name in STATE_COLUMNS if name in dataset.columns]
            recording = simulate_again(some, names, num_threads, bar.update)
            for lane, episode in enumerate(some):
                if not _is_equal(recording, lane, episode):
                    versions = dict(dataset.manifest.versions)
                    yield (
                        f"{dataset.folder}: episode {episode.number} simulated again differs: "
                        f"another machine, or other versions than {versions}?"
                    )


def simulate_again(
    episodes: Sequence[Episode], readings: Sequence[str], num_threads: int | None, tick: Tick
) -> Recording:
    """Simulate stored episodes, one in each lane; after its last action a lane gets zeros.

    Args:
        episodes: of one data set, at least one.
        readings: names of the fields of `Readings` to record.
        num_threads: threads to simulate on; None takes one for each core.
        tick: called after each step.
    """
    records = [episode.record for episode in episodes]
    simulation = Simulation(episodes[0].dataset.task, len(episodes), num_threads)
    simulation.restore(
        qpos=np.stack([stored["initial_qpos"] for stored in records]),
        qvel=np.stack([stored["initial_qvel"] for stored in records]),
        target_position=np.stack([stored["target_position"] for stored in records]),
        target_quaternion=np.stack([stored["target_quaternion"] for stored in records]),
    )
    actions = np.zeros((max(map(len, episodes)), len(episodes), 1))
    for lane, episode in enumerate(episodes):
        actions[: len(episode), lane] = episode["action"]
    return record(simulation, open_loop(actions), len(actions), readings, tick)


def _is_equal(recording: Recording, lane: int, episode: Episode) -> bool:
    """Whether a lane went through what is stored of an episode, to the last bit."""
    length, ends = len(episode), episode.record
    pairs = [(recording.reward[:length, lane], episode["reward"])]
    for name, values in recording.states.items():
        pairs.append((values[:length, lane], episode[name]))
        pairs.append((values[length, lane], ends[f"final_{name}"]))
    return all(_same_bits(*pair) for pair in pairs)


def _same_bits(one: NDArray[Any], other: NDArray[Any]) -> bool:
    return one.dtype == other.dtype and one.tobytes() == other.tobytes()
