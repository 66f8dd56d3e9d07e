"""The collector: a random policy on many Jitterbugs, written to shards."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from jbrep.dataset import shard_path, write_shard
from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import EPISODE_STEPS, get_task

SHARD_EPISODES = 100


@dataclass(frozen=True)
class Collection:
    """What to collect; the data are a function of this alone."""

    task: str
    steps: int  # rounded up to whole episodes
    seed: int = 0

    @property
    def episodes(self) -> int:
        """How many episodes."""
        return -(-self.steps // EPISODE_STEPS)


def collect(collection: Collection, folder: Path, num_threads: int | None = None) -> None:
    """Collect into a new folder, a shard after the other.

    Raises:
        InputError: unknown task, no steps, or data in the folder already.
    """
    task = get_task(collection.task)
    if collection.steps < 1:
        raise InputError(f"the number of steps is {collection.steps}: it must be at least 1")
    if shard_path(folder, 0).exists():
        raise InputError(f"{folder} holds a data set already: choose another folder")
    folder.mkdir(parents=True, exist_ok=True)
    attributes = {
        **asdict(collection),
        "policy": "uniform",
        "feature_names": list(task.feature_names),
        "feature_units": [feature.unit for feature in task.features],
    }
    episodes = np.arange(collection.episodes)
    with tqdm(total=len(episodes) * EPISODE_STEPS, unit="step", unit_scale=True) as progress:
        for shard, start in enumerate(range(0, len(episodes), SHARD_EPISODES)):
            columns = _collect_episodes(
                collection, episodes[start : start + SHARD_EPISODES], num_threads, progress
            )
            write_shard(shard_path(folder, shard), columns, attributes)


def _collect_episodes(
    collection: Collection, episodes: Any, num_threads: int | None, progress: "tqdm[None]"
) -> dict[str, Any]:
    simulation = Simulation(get_task(collection.task), len(episodes), num_threads)
    randoms = [_episode_random(collection.seed, episode) for episode in episodes]
    lanes = range(len(episodes))
    simulation.reset(lanes, randoms)
    actions = np.stack([r.uniform(-1, 1, (EPISODE_STEPS, 1)) for r in randoms], axis=1)
    rows = []
    for row in _rollout(simulation, actions.astype(np.float32)):
        rows.append(row)
        progress.update(len(episodes))
    observation, action, reward, alive = (np.stack(c, axis=1) for c in zip(*rows, strict=True))
    shape = alive.shape
    return {
        "observation": observation[alive],
        "action": action[alive],
        "reward": reward[alive],
        "episode": np.broadcast_to(np.asarray(episodes)[:, None], shape)[alive],
        "step": np.broadcast_to(np.arange(EPISODE_STEPS), shape)[alive],
    }


def _episode_random(seed: int, episode: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(episode),)))


def _rollout(simulation: Simulation, actions: Any) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Observation, action, reward and whether the physics held, for each step of (T, n, 1)."""
    alive = np.ones(simulation.num_lanes, dtype=bool)
    for action in actions:
        observation = simulation.observe().astype(np.float32)
        alive = alive & ~simulation.step(action)
        yield observation, action, simulation.reward(), alive
