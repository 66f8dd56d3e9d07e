"""Does a data set's physics come out again? Episodes simulated from their starts and actions."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset
from jbrep.dataset.schema import Columns
from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import EPISODE_STEPS
from jbrep.progress import Progress

_LANES = 100


def replay_problems(
    dataset: Dataset, episodes: int, num_threads: int | None = None
) -> Iterator[str]:
    """Simulate some episodes again from their stored start and actions, and compare every bit.

    Args:
        dataset: where they are.
        episodes: how many; they are drawn evenly at random, the same ones each time.
        num_threads: threads to simulate on; None takes one for each core.

    Yields:
        A line for each episode that comes out otherwise.

    Raises:
        InputError: fewer episodes are there.
    """
    total = len(dataset.episodes["episode"])
    if not 0 <= episodes <= total:
        raise InputError(f"{episodes} episodes can't be replayed: the data set has {total:,}")
    if not len(dataset):
        return
    chosen = np.sort(np.random.default_rng(0).permutation(total)[:episodes])
    with Progress(total=episodes * EPISODE_STEPS, unit="step", unit_scale=True, leave=False) as bar:
        for start in range(0, episodes, _LANES):
            for episode in _replay_some(dataset, chosen[start : start + _LANES], num_threads, bar):
                yield (
                    f"{dataset.folder}: episode {episode} simulated again differs: another "
                    f"machine, or other versions than {dict(dataset.manifest.versions)}?"
                )


def _replay_some(
    dataset: Dataset, chosen: NDArray[Any], num_threads: int | None, bar: Progress
) -> list[int]:
    own = {name: column[chosen] for name, column in dataset.episodes.items()}
    simulation = Simulation(dataset.task, len(chosen), num_threads)
    simulation.restore(
        *(own[n] for n in ("initial_qpos", "initial_qvel", "target_position", "target_quaternion"))
    )
    first = (np.cumsum(dataset.episodes["length"]) - dataset.episodes["length"])[chosen]
    names = [name for name in dataset.columns if name not in ("episode", "step")]
    columns = {name: dataset[name] for name in names}
    equal = np.ones(len(chosen), dtype=bool)
    for step in range(EPISODE_STEPS + 1):
        running = own["length"] > step
        rows = np.where(running, first + step, 0)
        stored = {name: column[rows] for name, column in columns.items()}
        ending = own["length"] == step
        seen: Columns = {
            "observation": simulation.observe().astype(np.float32),
            "qpos": simulation.readings.qpos,
            "qvel": simulation.readings.qvel,
        }
        for name, values in seen.items():
            if name in stored:
                equal &= _same(values, stored[name]) | ~running
                equal &= _same(values, own[f"final_{name}"]) | ~ending
        if step < EPISODE_STEPS:
            simulation.step(np.where(running[:, None], stored["action"], 0))
            reward = simulation.reward().astype(np.float32)
            equal &= _same(reward, stored["reward"]) | ~running
            bar.update(len(chosen))
    return chosen[~equal].tolist()


def _same(values: NDArray[Any], stored: NDArray[Any]) -> NDArray[np.bool_]:
    """Which lanes are equal in every bit."""
    one, other = (np.ascontiguousarray(a).reshape(len(a), -1) for a in (values, stored))
    same: NDArray[np.bool_] = (one.view(np.uint8) == other.view(np.uint8)).all(axis=1)
    return same
