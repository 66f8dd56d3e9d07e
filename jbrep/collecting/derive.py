"""Deriving data sets from the same motion: another task's, with other rewards or less to see."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from jbrep.collecting.collector import write_shards
from jbrep.collecting.policies import acts_on_observations
from jbrep.collecting.replay import replay_problems
from jbrep.collecting.shards import Growth, Produce
from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import Manifest, new_manifest, open_shard, policy_files, shard_image
from jbrep.dataset.rewards import reward_function, without_range
from jbrep.dataset.schema import EPISODES, Columns, episode_columns, some_episodes
from jbrep.envs.lanes import check_counts
from jbrep.envs.names import with_digest
from jbrep.envs.recording import Tick
from jbrep.envs.task import Task
from jbrep.envs.view import seen_in_episodes, with_view
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
) -> Manifest:
    """Write the data set that collecting another task with the same settings gives, bit for bit.

    Actions that don't depend on observations lead to the same states in every task. The source is
    finished and has its states; an unfinished derivation is resumed.
    """
    dataset = _finished(source)
    settings, before = dataset.manifest.settings, dataset.task
    if before.name not in TASKS:
        raise InputError(f"{source} is of {before.name}: only the Jitterbug's tasks share motion")
    if not settings.store_state:
        raise InputError(f"{source} has no states: collect it with --store-state")
    if acts_on_observations(settings.policy):
        raise InputError(
            f"{source} was collected by a {settings.policy['kind']} policy, which acts on "
            f"observations: run jbrep collect --task {task_name} instead"
        )
    if before.view:
        raise InputError(f"{source} shows a part of its states: derive the task from the whole")
    check_counts(1, num_threads)
    task = get_task(task_name)
    described = task.describe(before.arguments, before.max_episode_steps)
    settings = settings.replace(task=described, store_state=store_state, reward=UNSET)
    is_earlier = _is_of_earlier(dataset, settings)
    if is_earlier and (problem := next(replay_problems(dataset, 1, num_threads), None)):
        raise InputError(f"{problem}. A derived data set needs the same states")
    if (dataset.episodes["length"] < before.max_episode_steps).any():
        raise InputError(
            f"the physics diverged in {source}, after which no state is stored: run jbrep collect "
            f"--task {task_name} instead"
        )
    produce = _each_shard(dataset, _observed(task, settings, num_threads))
    return write_shards(settings, folder, produce, source=dataset.manifest)


def derive_view(
    source: Path,
    folder: Path,
    hidden: Sequence[str] = (),
    history: int = 1,
    reward: str = "",
) -> Manifest:
    """Write a data set of any robot with less or more to see, or with other rewards.

    What is hidden, and the history, are as `with_view` takes them; the reward, as `reward_function`
    does, is of what the source shows. An unfinished derivation is resumed.
    """
    dataset = _finished(source)
    settings = dataset.manifest.settings
    changes = list[Callable[[Columns], Columns]]()
    if reward:
        task = without_range(settings.task)
        named = with_digest(reward, "reward")
        settings = settings.replace(task=task, reward=named, unrewarded=UNSET)
        changes.append(_rewarded(reward))
    if hidden or history > 1:
        settings = settings.replace(task=with_view(settings.task, hidden, history))
        changes.append(_seen(settings.task))
    _is_of_earlier(dataset, settings)

    def changed(columns: Columns) -> Columns:
        for change in changes:
            columns = change(columns)
        return settings.columns(columns)

    def check(wanted: Manifest) -> None:
        _check_derived(folder, wanted, dataset, changed)

    files, produce = policy_files(source, dataset.manifest), _each_shard(dataset, changed)
    return write_shards(settings, folder, produce, files, check, dataset.manifest)


def _check_derived(
    folder: Path, wanted: Manifest, dataset: Dataset, change: Callable[[Columns], Columns]
) -> None:
    """Check that the shards of a folder are what comes of these data.

    Settings alone don't say so: they are the same of a log that was imported once more.
    """
    known, is_same = dataset.manifest, len(wanted.shards) <= len(dataset.manifest.shards)
    for shard, entry in enumerate(wanted.shards if is_same else ()):
        columns = change(open_shard(dataset.folder, known, shard))
        made, _ = shard_image(wanted, shard, some_episodes(columns, 0, entry.episodes))
        is_same = is_same and made == entry
    if not is_same:
        raise InputError(
            f"{folder} was derived from other data than {dataset.folder}: choose another folder"
        )


def _rewarded(code: str) -> Callable[[Columns], Columns]:
    rewards = reward_function(code)

    def change(columns: Columns) -> Columns:
        ends = np.cumsum(columns[EPISODES + "length"])[:-1]
        parts = (np.split(columns[name], ends) for name in ("observation", "action"))
        given = [rewards(*episode) for episode in zip(*parts, strict=True)]
        return {**columns, "reward": np.concatenate(given).astype(np.float32)}

    return change


def _seen(task: Task) -> Callable[[Columns], Columns]:
    final = EPISODES + "final_observation"
    given = "observation", "action", final, EPISODES + "length"

    def change(columns: Columns) -> Columns:
        before, last = seen_in_episodes(task, *(columns[name][:] for name in given))
        return {**columns, "observation": before, final: last}

    return change


def _finished(source: Path) -> Dataset:
    dataset = Dataset(source)
    if not dataset.manifest.complete:
        raise InputError(f"{source} is unfinished: resume it with the same jbrep collect")
    return dataset


def _is_of_earlier(dataset: Dataset, settings: DataSettings) -> bool:
    """Whether another jbrep made a data set; MuJoCo, NumPy and h5py must be the same."""
    earlier = dataset.manifest.versions
    versions = new_manifest(settings, dataset.manifest).versions
    if differing := differences({**earlier, "jbrep": versions["jbrep"]}, versions):
        raise InputError(
            f"{dataset.folder} was collected with other versions: {differing}; a derived data set "
            "needs the same"
        )
    return earlier["jbrep"] != versions["jbrep"]


def _each_shard(dataset: Dataset, change: Callable[[Columns], Columns]) -> Produce:
    def produce(growth: Growth, tick: Tick) -> Iterator[Columns]:
        manifest, each = dataset.manifest, dataset.manifest.settings.shard_episodes
        for shard in range(growth.episodes // each, len(manifest.shards)):
            columns = change(open_shard(dataset.folder, manifest, shard))
            known = growth.episodes - shard * each
            yield some_episodes(columns, known, manifest.shards[shard].episodes)

    return produce


def _observed(
    task: JitterbugTask, settings: DataSettings, num_threads: int | None
) -> Callable[[Columns], Columns]:
    def change(columns: Columns) -> Columns:
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
        observation, reward = read(states)
        changed = {
            "observation": observation[row],
            "reward": reward[row + 1],
            EPISODES + "final_observation": observation[final],
            **{EPISODES + name: values for name, values in target.items()},
        }
        return settings.columns({**columns, **changed})

    def read(states: Mapping[str, Array]) -> tuple[Array, Array]:
        """Observations (n, d) and rewards (n,) of states, as `Simulation.restore` takes them."""
        n = len(states["qpos"])
        lanes = min(_LANES, n)
        simulation = Simulation(task, lanes, num_threads, **settings.task.arguments)
        observation = np.empty((n, settings.task.size), np.float32)
        reward = np.empty(n, np.float32)
        for start in range(0, n, lanes):
            rows = slice(min(start, n - lanes), start + lanes)  # the last ones overlap
            simulation.restore(**{name: values[rows] for name, values in states.items()})
            observation[rows], reward[rows] = simulation.observe(), simulation.reward()
        return observation, reward

    return change
