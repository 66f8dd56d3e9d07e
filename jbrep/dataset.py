"""The data set: a folder of HDF5 shards of flat columns."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from jbrep.errors import InputError
from jbrep.jitterbug.tasks import Task, get_task

COLUMNS = {  # name: dtype; the first axis is the row, in the order of episode, then step
    "observation": np.float32,  # (N, d) in physical units, before the action
    "action": np.float32,  # (N, 1)
    "reward": np.float32,  # (N,) after the action
    "episode": np.int32,  # (N,) unique in the data set
    "step": np.int32,  # (N,) from 0 in each episode
}


def shard_path(folder: Path, shard: int) -> Path:
    """Where the shard of that number stands."""
    return folder / f"shard-{shard:05d}.h5"


def write_shard(path: Path, columns: Mapping[str, Any], attributes: Mapping[str, Any]) -> None:
    """Write a shard under a temporary name, then rename it: a reader sees all of it or nothing."""
    partial = path.with_suffix(".partial")
    with h5py.File(partial, "w") as file:
        for name, dtype in COLUMNS.items():
            file.create_dataset(name, data=np.asarray(columns[name], dtype=dtype))
        file.attrs.update(attributes)
    with partial.open("rb") as written:
        os.fsync(written.fileno())
    partial.rename(path)


class Dataset:
    """A collected data set, in memory.

    Args:
        folder: where `jbrep collect` wrote it.

    Attributes:
        task: the task whose features the observations hold.
        columns: by name, as in `COLUMNS`.

    Raises:
        InputError: no data set there.
    """

    def __init__(self, folder: Path):
        shards = sorted(folder.glob("shard-*.h5"))
        if not shards:
            raise InputError(f"no data set in {folder}: a folder with shard-*.h5 is expected")
        parts = []
        for shard in shards:
            with h5py.File(shard) as file:
                parts.append({name: file[name][:] for name in COLUMNS})
                self.task: Task = get_task(file.attrs["task"])
        self.columns = {name: np.concatenate([part[name] for part in parts]) for name in COLUMNS}

    def __len__(self) -> int:
        return len(self.columns["step"])

    def split(self, test: float = 0.2, seed: int = 0) -> tuple[NDArray[Any], NDArray[Any]]:
        """Rows to train on and rows held out; no episode is in both.

        Args:
            test: share of the episodes to hold out, at least one of them.
            seed: of the draw.

        Returns:
            Two sorted arrays of row numbers.

        Raises:
            InputError: fewer than two episodes.
        """
        row_episodes = self.columns["episode"]
        episodes = np.unique(row_episodes)
        if len(episodes) < 2:
            raise InputError(f"{len(episodes)} episode can't be split: collect at least 2")
        held_out = np.random.default_rng(seed).permutation(episodes)
        held_out = held_out[: max(1, round(test * len(episodes)))]
        is_test = np.isin(row_episodes, held_out)
        return np.flatnonzero(~is_test), np.flatnonzero(is_test)
