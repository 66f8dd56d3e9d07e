"""The columns of a data set, and how an episode's seed and policy are determined."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Task
from jbrep.errors import InputError

Columns = Mapping[str, NDArray[Any]]

FORMAT = "jbrep data set"
FORMAT_VERSION = 2
EPISODES = "episodes/"  # the HDF5 group of the columns with one row for each episode

UNKNOWN_SEED = -1  # of an imported episode
MAX_ROOT_SEED = 2**31 - 2  # so that an episode's seed has 63 bits
_PART_STREAM = 0x6D6978  # beside an episode's seed: nothing else is drawn from that stream
_EPISODE_BITS = {63: 32, 31: 20}  # of a seed, for the number of the episode
_COLUMNS = {  # of every data set
    *("observation", "action", "reward", "episode", "step"),
    *("seed", "length", "return", "terminated", "truncated", "diverged", "policy"),
}


@dataclass(frozen=True)
class Spec:
    """Type of a column and shape of one of its rows."""

    dtype: np.dtype[Any]
    row: tuple[int, ...] = ()

    def shape(self, rows: int) -> tuple[int, ...]:
        """Shape of the whole column."""
        return (rows, *self.row)


def _spec(dtype: str, *row: int) -> Spec:
    return Spec(np.dtype(dtype), row)


def step_specs(task: Task, store_state: bool) -> dict[str, Spec]:
    """Columns with a row for each step, in the order of episode, then step."""
    specs = {
        "observation": _spec("<f4", task.size),  # before the action, in physical units
        "action": _spec("<f4", task.action_size),  # within the task's bounds
        "reward": _spec("<f4"),  # of the state that the action led to; 0 if the physics diverged
        "episode": _spec("<i4"),  # from 0 in the data set
        "step": _spec("<i4"),  # from 0 in the episode
    }
    if store_state:  # with the observation
        specs |= {name: _spec("<f8", width) for name, width in task.state.items()}
    return specs


def episode_specs(task: Task, store_state: bool, version: int = FORMAT_VERSION) -> dict[str, Spec]:
    """Columns with a row for each episode.

    In format version 1, an episode whose physics diverged lacks its last row.
    """
    ends = ("diverged",) if version == 1 else ("terminated", "truncated")
    specs = {
        "episode": _spec("<i4"),
        "seed": _spec("<i8"),
        "length": _spec("<i4"),  # rows stored
        "return": _spec("<f8"),  # sum of the rewards stored
        **{name: _spec("|u1") for name in ends},
        **{f"initial_{name}": _spec("<f8", width) for name, width in task.state.items()},
        **{name: _spec("<f8", width) for name, width in task.constants.items()},
        "final_observation": _spec("<f4", task.size),  # after the last action
    }
    if store_state:
        specs |= {f"final_{name}": _spec("<f8", width) for name, width in task.state.items()}
    return {EPISODES + name: spec for name, spec in specs.items()}


MIXTURE_SPECS = {EPISODES + "policy": _spec("<i4")}  # the number of the part of a mixture


def check_names(task: Task) -> None:
    """Make sure that no array of the task's states would be stored in the place of a column.

    Raises:
        InputError: one has the name of a column.
    """
    for name in task.arrays:
        if name in _COLUMNS or name.startswith(("initial_", "final_")):
            raise InputError(f"{task.name} has an array {name!r}: data sets have such a column")


def all_specs(task: Task, store_state: bool, version: int = FORMAT_VERSION) -> dict[str, Spec]:
    """All columns of a shard, by their paths in the file."""
    return step_specs(task, store_state) | episode_specs(task, store_state, version)


def episode_columns(columns: Columns) -> dict[str, NDArray[Any]]:
    """The columns of a shard with a row for each episode, by their names in the group."""
    return {
        name.removeprefix(EPISODES): column
        for name, column in columns.items()
        if name.startswith(EPISODES)
    }


def episode_seed(task: Task, root: int, episode: int) -> int:
    """The seed of an episode: (root + 1) * 2**32 + episode.

    No two episodes share one, within a data set or between data sets of different root seeds,
    and none is as small as the seeds that people choose. `env.reset(seed=...)` with it starts
    the same episode. For an environment that takes seeds of 31 bits only, it is
    (root + 1) * 2**20 + episode.

    Raises:
        InputError: a root or an episode beyond what such an environment can have.
    """
    bits = _EPISODE_BITS[task.seed_bits]
    seed = ((root + 1) << bits) + episode
    if episode >> bits or seed >> task.seed_bits:
        raise InputError(
            f"{task.name} takes seeds of {task.seed_bits} bits: the data set's seed must be at "
            f"most {(1 << (task.seed_bits - bits)) - 2:,}, with at most {1 << bits:,} episodes"
        )
    return seed


def episode_part(seed: int, weights: Sequence[float]) -> int:
    """The number of the policy that acts in an episode, of a mixture with these weights.

    It is drawn from NumPy's default generator with the episode's seed and a constant: a stream that
    neither the environment nor a policy uses.
    """
    ends = np.cumsum(weights)
    drawn = np.random.default_rng([seed, _PART_STREAM]).random() * ends[-1]
    return min(int(np.searchsorted(ends, drawn, side="right")), len(ends) - 1)


def episode_bounds(lengths: NDArray[Any]) -> NDArray[np.int64]:
    """Where episodes begin and end: episode i has rows bounds[i] to bounds[i + 1], (n + 1,)."""
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


def episode_returns(reward: NDArray[np.float32], lengths: NDArray[Any]) -> NDArray[np.float64]:
    """Sum of the stored rewards of each episode, in double precision, in the order of rows."""
    owner = np.repeat(np.arange(len(lengths)), lengths)
    return np.bincount(owner, reward, len(lengths)).astype(np.float64)
