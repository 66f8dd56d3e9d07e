"""Exporting to Minari's HDF5 storage, with the environment that it recovers."""

import copy
import json
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer
from minari.namespace import NAMESPACE_METADATA_FILENAME

import jbrep.jitterbug.simulation  # noqa: F401  Minari makes the environment: load MuJoCo before
from jbrep.dataset import Dataset, Settings
from jbrep.dataset.schema import UNKNOWN_SEED
from jbrep.envs.names import find_spec
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.progress import Progress
from jbrep.records.publish import publish_folder, unfinished
from jbrep.records.storage import exists, write_whole

_ROOT = "MINARI_DATASETS_PATH"  # Minari takes the folder of its data sets from the environment only


def write(dataset: Dataset, out: Path) -> str:
    """Add a data set to a folder of Minari data sets; returns how to open it."""
    settings = dataset.manifest.settings
    name = f"{_namespace(settings.task)}/{settings.policy['kind']}-v0"
    path = out / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with unfinished(path) as root:  # Minari ignores hidden folders
        root.mkdir()
        with _datasets_in(root.resolve()), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on the missing author and address
            _create(dataset, name)
        for namespace in Path(name).parents[:-1]:
            metadata = namespace / NAMESPACE_METADATA_FILENAME
            if not exists(out / metadata):
                write_whole(out / metadata, (root / metadata).read_bytes())
        publish_folder(root / name, path)
    return f"{_ROOT}={out} and minari.load_dataset({name!r})"


def _namespace(task: Task) -> str:
    """Jitterbug's tasks stand together; another's id has no version there."""
    if task.id.startswith("Jitterbug/"):
        return f"jitterbug/{task.slug}"
    name = re.sub(r"[^A-Za-z0-9_/-]+", "-", task.id)
    return name if len(name) > 1 else f"task-{name}"  # Minari takes no single letter


def _create(dataset: Dataset, name: str) -> None:
    settings, versions = dataset.manifest.settings, dataset.manifest.versions
    minari.create_dataset_from_buffers(
        name,
        _episodes(dataset),
        env=_environment(settings),
        observation_space=spaces.Box(-np.inf, np.inf, (settings.task.size,), np.float32),
        action_space=_actions(settings.task),
        algorithm_name=settings.policy["kind"],
        description=f"{json.dumps(settings.as_json())} {dataset.manifest.fingerprint}",
        requirements=[f"{package}=={versions[package]}" for package in ("jbrep", "mujoco")],
    )


def _actions(task: Task) -> spaces.Box:
    low, high = (np.array(ends, np.float32) for ends in (task.action_low, task.action_high))
    return spaces.Box(low, high, dtype=np.float32)


def _environment(settings: Settings) -> EnvSpec | None:
    """What Minari recovers the environment from: with the arguments and the time limit.

    None for one that was registered with a class or function: only a name can be written down.
    None, too, for imported data of one that isn't there.
    """
    task = settings.task
    try:
        spec = copy.deepcopy(find_spec(task.id))
    except (InputError, ModuleNotFoundError):
        if settings.is_imported:
            return None
        raise
    spec.kwargs.update(task.arguments)
    spec.max_episode_steps = task.max_episode_steps
    return None if callable(spec.entry_point) else spec


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    before = os.environ.get(_ROOT)
    os.environ[_ROOT] = str(folder)
    try:
        yield
    finally:
        del os.environ[_ROOT]
        if before is not None:
            os.environ[_ROOT] = before


def _episodes(dataset: Dataset) -> Iterator[EpisodeBuffer]:
    for number in Progress(range(len(dataset.episodes["length"])), unit="episode", desc="minari"):
        episode = dataset.episode(number)
        if not len(episode):
            continue  # it diverged in its first step (format version 1): Minari refuses it
        ends, is_last = episode.record, np.arange(len(episode)) == len(episode) - 1
        seed = int(ends["seed"])
        yield EpisodeBuffer(
            seed=None if seed == UNKNOWN_SEED else seed,
            observations=np.append(episode["observation"], ends["final_observation"][None], axis=0),
            actions=episode["action"],
            rewards=episode["reward"].astype(np.float64),
            terminations=is_last & bool(ends["terminated"]),
            truncations=is_last & bool(ends["truncated"]),
            infos={},
        )
