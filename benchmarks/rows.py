"""Data sets that the benchmarks make up."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import commit, new_manifest
from jbrep.dataset.schema import EPISODES
from jbrep.envs import describe


def make_rows(
    folder: Path, task: str, steps: int, draw: Callable[[str, tuple[int, ...]], np.ndarray]
) -> Dataset:
    """Whole episodes, in the shards that a collector writes.

    Args:
        folder: to be created.
        task: the name.
        steps: of all episodes.
        draw: the values of a column, from its name and shape.
    """
    settings = DataSettings(task=describe(task), steps=steps)
    manifest = new_manifest(settings)
    length, episodes = settings.task.max_episode_steps, settings.shard_episodes
    folder.mkdir()
    while not manifest.complete:
        columns = {}
        for name, spec in manifest.settings.specs().items():
            rows = episodes if name.startswith(EPISODES) else episodes * length
            columns[name] = draw(name, (rows, *spec.row)).astype(spec.dtype)
        columns[EPISODES + "length"][:] = length
        manifest = commit(folder, manifest, columns)
    return Dataset(folder)
