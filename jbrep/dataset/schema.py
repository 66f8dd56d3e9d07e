"""What determines a data set, and the columns that follow from it."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from jbrep.dataset import settings
from jbrep.envs.task import Task
from jbrep.errors import InputError, refusing
from jbrep.records.record import Record, pattern, to_plain

Columns = Mapping[str, NDArray[Any]]

EPISODES = "episodes/"  # the HDF5 group of the columns with one row for each episode
UNKNOWN_SEED = -1  # of an imported episode
_PART_STREAM = 0x6D6978  # beside an episode's seed: nothing else is drawn from that stream
_EPISODE_BITS = {63: 32, 31: 20}  # of a seed, for the number of the episode

_Code = Annotated[
    str,
    pattern(
        r"(?a)\A[\w.]+:[\w.]+ [0-9a-f]{12}\Z",
        "module:function and the first 12 digits of its hash",
        max_length=settings.MAX_LETTERS,
    ),
]


class Spec(NamedTuple):
    """Type of a column, shape of a row, and what computes it from other columns, if anything."""

    dtype: np.dtype[Any]
    row: tuple[int, ...] = ()
    follows: Callable[[Columns], NDArray[Any]] | None = None


def _spec(dtype: str, *row: int, follows: Callable[[Columns], NDArray[Any]] | None = None) -> Spec:
    return Spec(np.dtype(dtype), row, follows)


class DataSettings(Record, frozen=True, kw_only=True):
    """What determines the data, and how they are divided into shards."""

    steps: settings.Steps
    seed: settings.RootSeed = 0
    shard_episodes: settings.ShardEpisodes = 100
    store_state: settings.StoreState = False
    task: Task = msgspec.field(name="environment")
    policy: settings.PolicySettings = msgspec.field(default_factory=lambda: {"kind": "uniform"})
    unrewarded: Literal[True] | UnsetType = UNSET  # imported data that have no rewards
    reward: _Code | UnsetType = UNSET  # what has given the rewards, if not the environment

    def check(self) -> None:
        with refusing("the policy lacks a setting", (LookupError, TypeError, ValueError)):
            for policy in settings.parts_of(self.policy):
                if policy["kind"] == settings.TRAINED:
                    itemgetter("file", "sha256", "run", "step")(policy)
        self.specs()
        episode_seed(self.task, self.seed, (self.steps - 1) // self.task.max_episode_steps)
        if self.store_state and not self.task.state:
            raise InputError(f"{self.task.name} has no states to store: its observations are all")
        if self.task.domain:
            raise InputError(
                f"{self.task.name} draws its {self.task.domain} in each episode: data sets are of "
                "the robot as it is, so describe it without a domain"
            )

    def as_json(self) -> dict[str, Any]:
        """The settings as plain JSON, with the task's name."""
        plain = to_plain(self)
        about = {name: plain.pop(name) for name in ("environment", "policy")}
        return {"task": self.task.name, **about, **plain}

    @property
    def weights(self) -> list[float]:
        """The weights of a mixture's parts; of another policy, none."""
        parts = self.policy["parts"] if self.policy["kind"] == settings.MIXTURE else ()
        return [weight for weight, _ in parts]

    @property
    def is_imported(self) -> bool:
        """Whether the data were made elsewhere: no episode can be simulated again."""
        return bool(self.policy["kind"] == settings.IMPORTED)

    def specs(self) -> dict[str, Spec]:
        """The columns of each shard, by their paths in the file."""
        task, number, length = self.task, EPISODES + "episode", EPISODES + "length"

        def steps_of(known: Columns) -> NDArray[Any]:
            rows, firsts = len(known["action"]), episode_bounds(known[length])[:-1]
            return np.arange(rows) - np.repeat(firsts, known[length])

        def parts(known: Columns) -> NDArray[Any]:
            seeds = known[EPISODES + "seed"].tolist()
            return np.array([episode_part(seed, self.weights) for seed in seeds], np.int64)

        def returns(known: Columns) -> NDArray[Any]:
            return episode_returns(known["reward"], known[length])

        moving = {name: _spec("<f8", width) for name, width in task.state.items()}
        steps = {  # a row for each step, in the order of episode, then step
            "observation": _spec("<f4", task.size),  # before the action, in physical units
            "action": _spec("<f4", task.action_size),  # within the task's bounds
            "reward": _spec("<f4"),  # of the state that it led to; 0 if the physics diverged
            "episode": _spec("<i4", follows=lambda known: np.repeat(known[number], known[length])),
            "step": _spec("<i4", follows=steps_of),  # from 0 in the episode
        }
        once = {  # a row for each episode
            "episode": _spec("<i4"),  # its number, from 0 in the data set
            "seed": _spec("<i8"),
            "length": _spec("<i4"),  # rows stored
            "return": _spec("<f8", follows=returns),
            "terminated": _spec("|u1"),
            "truncated": _spec("|u1"),
        }
        policy = {"policy": _spec("<i4", follows=parts)}  # the number of the part of a mixture
        missing = {"missing": _spec("<i4")}  # readings, see `Task.missing`
        taken = {**steps, **once, **policy, **missing}
        for name in task.arrays:
            if name in taken or name.startswith(("initial_", "final_")):
                raise InputError(f"{task.name} has an array {name!r}: data sets have such a column")
        once |= {f"initial_{name}": spec for name, spec in moving.items()}
        once |= {name: _spec("<f8", width) for name, width in task.constants.items()}
        once["final_observation"] = _spec("<f4", task.size)  # after the last action
        if self.store_state:
            steps |= moving  # with the observation
            once |= {f"final_{name}": spec for name, spec in moving.items()}
        once |= (policy if self.weights else {}) | (missing if task.missing else {})
        if self.unrewarded:
            del steps["reward"], once["return"]
        return steps | {EPISODES + name: spec for name, spec in once.items()}

    def step_specs(self) -> dict[str, Spec]:
        """Those with a row for each step."""
        return {n: spec for n, spec in self.specs().items() if not n.startswith(EPISODES)}

    def columns(self, known: Columns) -> Columns:
        """All columns of some episodes, in order, given those that others don't imply."""
        return {
            name: np.asarray(spec.follows(known) if spec.follows else known[name], spec.dtype)
            for name, spec in self.specs().items()
        }

    def seeds(self, episodes: Iterable[int]) -> NDArray[np.int64]:
        """The seeds that episodes of these numbers have."""
        return np.array([episode_seed(self.task, self.seed, int(n)) for n in episodes], np.int64)

    def row_bytes(self) -> int:
        """Bytes for each step."""
        specs = self.step_specs().values()
        return sum(spec.dtype.itemsize * math.prod(spec.row) for spec in specs)


def episode_columns(columns: Mapping[str, Any]) -> dict[str, Any]:
    """What has a row for each episode, of columns or specs, by the names in the group."""
    names = (name for name in columns if name.startswith(EPISODES))
    return {name.removeprefix(EPISODES): columns[name] for name in names}


def some_episodes(columns: Columns, first: int, stop: int) -> Columns:
    """The columns of some of their episodes: from the first on, before the one to stop at."""
    bounds = episode_bounds(columns[EPISODES + "length"][:stop])
    rows = slice(int(bounds[min(first, len(bounds) - 1)]), int(bounds[-1]))
    return {
        name: values[first:stop] if name.startswith(EPISODES) else values[rows]
        for name, values in columns.items()
    }


def joined(several: Sequence[Columns]) -> Columns:
    """The columns of episodes, one after the other."""
    return {name: np.concatenate([each[name] for each in several]) for name in several[0]}


def episode_seed(task: Task, root: int, episode: int) -> int:
    """The seed of an episode: (root + 1) * 2**32 + episode.

    No two episodes share one, within a data set or between data sets of different root seeds,
    and none is as small as the seeds that people choose. `env.reset(seed=...)` with it starts
    the same episode. For an environment that takes seeds of 31 bits only, it is
    (root + 1) * 2**20 + episode.
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
