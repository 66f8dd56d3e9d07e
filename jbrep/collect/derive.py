"""Deriving another task's data set: the same motion, with its observations and rewards."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.collector import Written, write_shards
from jbrep.collect.policies import acts_on_observations
from jbrep.collect.replay import replay_problems
from jbrep.collect.shards import Missing, Produce
from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import new_manifest, open_shard
from jbrep.dataset.schema import EPISODES, Columns, Frame, episode_columns
from jbrep.envs.lanes import check_counts
from jbrep.envs.recording import Tick
from jbrep.errors import InputError, differences
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import TASKS, JitterbugTask, get_task

_LANES = 500

Array = NDArray[Any]


def derive(
    source: Path,
    task_name: str,
    folder: Path,
    store_state: bool = False,
    num_threads: int | None = None,
) -> Written:
    """Write the data set that collecting another task with the same settings gives, bit for bit.

    Actions that don't depend on observations lead to the same states in every task.

    Args:
        source: a finished data set with stored states.
        task_name: the task to observe and reward.
        folder: where to write; an unfinished derivation is resumed.
        store_state: store the states as well.
        num_threads: threads to use; None takes one for each core.

    Raises:
        InputError: the source has no states, is unfinished or damaged, was collected by a policy
            that depends on observations or with other versions; or as `collect` does.
    """
    dataset = Dataset(source)
    settings = dataset.manifest.settings
    if dataset.task.name not in TASKS:
        raise InputError(
            f"{source} is of {dataset.task.name}: only the Jitterbug's tasks share their motion"
        )
    if not settings.store_state:
        raise InputError(f"{source} has no states: collect it with --store-state")
    if not dataset.manifest.complete:
        raise InputError(f"{source} is unfinished: resume it with the same jbrep collect")
    if acts_on_observations(settings.policy):
        raise InputError(
            f"{source} was collected by a {settings.policy['kind']} policy, which acts on "
            f"observations: run jbrep collect --task {task_name} instead"
        )
    check_counts(1, num_threads)
    task, before = get_task(task_name), dataset.task
    described = task.describe(before.arguments, before.max_episode_steps)
    settings = settings.replace(task=described, store_state=store_state)
    versions = new_manifest(settings).versions
    _check_versions(dataset, versions, num_threads)
    if (dataset.episodes["length"] < before.max_episode_steps).any():
        raise InputError(
            f"the physics diverged in {source}, after which no state is stored: run jbrep collect "
            f"--task {task_name} instead"
        )
    return write_shards(settings, folder, _deriving(dataset, task, settings, num_threads))


def _check_versions(dataset: Dataset, versions: Mapping[str, str], num_threads: int | None) -> None:
    """Check that this jbrep, MuJoCo and NumPy give the states of a data set; jbrep may be later."""
    earlier = dataset.manifest.versions
    if differing := differences({**earlier, "jbrep": versions["jbrep"]}, versions):
        raise InputError(
            f"{dataset.folder} was collected with other versions: {differing}; a derived data set "
            "needs the same"
        )
    if earlier["jbrep"] != versions["jbrep"] and (
        problem := next(replay_problems(dataset, 1, num_threads), None)
    ):
        raise InputError(f"{problem} A derived data set needs the same states")


def _deriving(
    dataset: Dataset, task: JitterbugTask, settings: DataSettings, num_threads: int | None
) -> Produce:
    """Make the shards of a data set as another task observes and rewards them."""

    def produce(first: int, missing: Missing, tick: Tick) -> Iterator[Columns]:
        for shard in range(first, len(dataset.manifest.shards)):
            columns = open_shard(dataset.folder, dataset.manifest, shard)
            yield _as_task(columns, task, settings, tick, num_threads)

    return produce


def _as_task(
    columns: Columns,
    task: JitterbugTask,
    settings: DataSettings,
    tick: Tick,
    num_threads: int | None,
) -> Columns:
    """The columns of a shard as another task observes and rewards them."""
    own = episode_columns(columns)
    length = own["length"]
    starts = [task.start(np.random.default_rng(int(seed))) for seed in own["seed"]]
    target = {
        "target_position": np.stack([start.target_position for start in starts]),
        "target_quaternion": np.stack([start.target_quaternion for start in starts]),
    }
    episode = np.repeat(np.arange(len(length)), length)
    row = np.arange(len(episode)) + episode  # its place once final states are inserted
    ends = np.cumsum(length)
    final = ends + np.arange(len(length))
    constants = target | ({"body": own["body"][:, 0]} if "body" in own else {})
    states = {
        **{n: np.insert(columns[n], ends, own[f"final_{n}"], axis=0) for n in ("qpos", "qvel")},
        **{name: np.repeat(values, length + 1, axis=0) for name, values in constants.items()},
    }
    observation, reward = _read(states, task, settings.task.arguments, num_threads)
    tick(len(row))
    changed = {
        "observation": observation[row],
        "reward": reward[row + 1],
        EPISODES + "final_observation": observation[final],
        **{EPISODES + name: values for name, values in target.items()},
    }
    frame = Frame(own["episode"], own["seed"], length, changed["reward"], settings.weights)
    return settings.columns({**columns, **changed}, frame)


def _read(
    states: Mapping[str, Array],
    task: JitterbugTask,
    body: Mapping[str, Any],
    num_threads: int | None,
) -> tuple[Array, Array]:
    """Observations (n, d) and rewards (n,) of the states, as `Simulation.restore` takes them.

    The body is what chooses it of the arguments of `Simulation`.
    """
    n = len(states["qpos"])
    lanes = min(_LANES, n)
    simulation = Simulation(task, lanes, num_threads, **body)
    observation, reward = np.empty((n, task.plain.size), np.float32), np.empty(n, np.float32)
    for start in range(0, n, lanes):
        rows = slice(min(start, n - lanes), start + lanes)  # the last ones overlap
        simulation.restore(**{name: values[rows] for name, values in states.items()})
        observation[rows], reward[rows] = simulation.observe(), simulation.reward()
    return observation, reward
