"""Data sets in Minari's storage, with the environment that it recovers.

They may be strangers': nothing outside their folder is read, and no environment is made with
arguments that may name files.
"""

import copy
import json
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces.utils import flatdim, flatten
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from minari.namespace import NAMESPACE_METADATA_FILENAME

from jbrep.dataset.columns import Array
from jbrep.dataset.formats.arrays import frame_of_steps, joined
from jbrep.dataset.formats.frame import About, Frame, check_plain, label_of
from jbrep.dataset.formats.hdf5 import opened
from jbrep.dataset.reader import Dataset
from jbrep.dataset.rewards import without_range
from jbrep.dataset.schema import UNKNOWN_SEED, DataSettings
from jbrep.envs.description import describe
from jbrep.envs.names import spec_of
from jbrep.envs.probe import features_of
from jbrep.envs.task import Task
from jbrep.errors import InputError, kind_and_line, listed
from jbrep.progress import Progress
from jbrep.records.storage import check_space, exists, make_folder, publish, unfinished, write_whole

_ROOT = "MINARI_DATASETS_PATH"
_METADATA = "metadata.json"
_OWN = "jbrep"  # in that of what was exported: what Minari has no place for
_NAMES = {"reward": "rewards", "terminated": "terminations", "truncated": "truncations"}
_WORD = re.compile(r"[\w-]{1,40}")
_EPISODE_BYTES = 1 << 14  # that HDF5 takes for each episode besides its rows


def read(given: str) -> Frame:
    """Read a Minari data set by its folder, or its id in the folder where Minari keeps them."""
    folder = _folder(given)
    check_plain(folder)
    for path in sorted(folder.rglob("*.hdf5")):
        with opened(path):
            pass
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        metadata = json.loads((folder / _METADATA).read_bytes())
        if lacking := {"observation_space", "action_space"} - metadata.keys():
            raise InputError(f"{folder / _METADATA} has no {min(lacking)}")  # Minari would run code
        stored = MinariStorage.read(folder)
        seen, actions = stored.observation_space, stored.action_space
        name = f"Minari {metadata.get('dataset_id', given)}"
        features = tuple(features_of(name, seen))
        if not isinstance(actions, spaces.Box) or actions.dtype.kind != "f":
            raise InputError(f"{name} has actions in {actions}: only continuous ones are possible")
        numbers, episodes = range(stored.total_episodes), dict[str, dict[str, Array]]()
        for number, episode in enumerate(stored.get_episodes(numbers)):
            arrays = {role: np.asarray(episode[each]) for role, each in _NAMES.items()}
            arrays["observation"] = _flat(seen, episode["observations"])  # a row more than others
            arrays["action"] = _flat(actions, episode["actions"])
            episodes[f"episode {number}"] = arrays
        seeds = [each.get("seed") for each in stored.get_episode_metadata(numbers)]
        own = metadata.get(_OWN, {})
        offsets, own_reward = (*map(float, own.get("offsets", ())),), own.get("own_reward", "")
    task, why_not, label, limit = _task(metadata, label_of(name), (len(features), flatdim(actions)))
    columns, place = joined(name, episodes)
    about = About(features=task.features if task else features, offsets=offsets)
    return frame_of_steps(
        name,
        columns,
        {"seed": [UNKNOWN_SEED if seed is None else int(seed) for seed in seeds]},
        about,
        label=label,
        place=place,
        task=without_range(task) if task and own_reward else task,
        own_reward=own_reward,
        why_no_task=why_not,
        action_bounds=(actions.low.ravel(), actions.high.ravel()),
        max_episode_steps=limit,
    )


def _folder(given: str) -> Path:
    root = Path(os.environ.get(_ROOT) or Path.home() / ".minari" / "datasets")
    for folder in (Path(given), Path(given) / "data", root / given / "data"):
        if exists(folder / _METADATA):
            return folder
    there = sorted(path.parents[1] for path in root.glob(f"**/data/{_METADATA}"))
    names = [path.relative_to(root).as_posix() for path in there]
    raise InputError(
        f"nothing to import at {given}: give a file or folder that docs/logs.md lists, or the id "
        f"of a Minari data set in {root} ({_ROOT}): {listed(names) or 'there are none'}"
    )


def _task(
    metadata: dict[str, Any], label: str, sizes: tuple[int, int]
) -> tuple[Task | None, str, str, int | None]:
    """The task, if its environment can be made here, or why not; a label, and the time limit."""
    try:
        spec = json.loads(metadata["env_spec"])
        env_id, arguments, given = spec["id"], dict(spec["kwargs"]), spec["max_episode_steps"]
        limit = int(given) if given else None
    except (KeyError, ValueError, TypeError):
        return None, Frame.why_no_task, label, None
    if not _is_harmless(arguments):
        why_not = f"the arguments of {env_id} may name files, so that it isn't made"
        return None, why_not, env_id, limit
    try:
        task = describe(str(env_id), arguments, limit)
    except (InputError, ModuleNotFoundError) as error:
        return None, kind_and_line(error), env_id, limit
    if (task.size, task.action_size) != sizes:
        return None, f"{env_id} has other sizes", label, limit
    return task, "", env_id, limit


def _is_harmless(value: Any) -> bool:
    """Whether an argument of a stranger's can't name a file: numbers and words."""
    if isinstance(value, dict):
        return all(map(_is_harmless, (*value, *value.values())))
    if isinstance(value, list):
        return all(map(_is_harmless, value))
    return not isinstance(value, str) or bool(_WORD.fullmatch(value) and not exists(value))


def _flat(space: spaces.Space[Any], values: Any) -> Array:
    """Observations as Gymnasium flattens them, (n, ...) to (n, d)."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts: Any = space.spaces
        keys = parts if isinstance(parts, dict) else range(len(parts))
        return np.concatenate([_flat(parts[key], values[key]) for key in keys], axis=1)
    array = np.asarray(values)
    if not isinstance(space, spaces.Box):
        array = np.array([flatten(space, value) for value in array])
    return array.reshape(len(array), flatdim(space))


def write(dataset: Dataset, out: Path) -> str:
    """Add a data set to a folder of Minari data sets; returns how to open it."""
    settings, task, versions = dataset.manifest.settings, dataset.task, dataset.manifest.versions
    namespace = f"jitterbug/{task.slug}" if task.id.startswith("Jitterbug/") else task.name
    namespace = re.sub(r"[^A-Za-z0-9_/-]+", "-", namespace)
    namespace = namespace if len(namespace) > 1 else f"task-{namespace}"  # no single letter
    name = f"{namespace}/{settings.policy['kind']}-v0"
    dataset["reward"]  # says what to do if there are none
    own: dict[str, Any] = {"own_reward": settings.reward} if settings.reward else {}
    own |= {"offsets": task.offset.tolist()} if task.offset.any() else {}
    about = {
        "dataset_id": name,
        "minari_version": minari.__version__,
        "algorithm_name": settings.policy["kind"],
        "description": f"{json.dumps(settings.as_json())} {dataset.fingerprint}",
        "requirements": [f"{package}=={versions[package]}" for package in ("jbrep", "mujoco")],
        _OWN: own,
    }
    bounds = np.array((task.action_low, task.action_high), np.float32)
    seen = spaces.Box(-np.inf, np.inf, (task.size,), np.float32)
    out = out.absolute()  # Minari joins a relative path to itself
    path, actions, spec = out / name, spaces.Box(*bounds, dtype=np.float32), _env_spec(settings)
    make_folder(path.parent)
    episodes = len(dataset.episodes["length"]) * _EPISODE_BYTES
    check_space(path.parent, len(dataset) * settings.row_bytes() + episodes)
    with unfinished(path) as partial:  # Minari ignores hidden folders
        partial.mkdir()
        made = MinariStorage.new(partial / "data", seen, actions, spec)
        made.update_metadata(about)
        made.update_episodes(_buffers(dataset))
        for parent in Path(name).parents[:-1]:
            if not exists(metadata := out / parent / NAMESPACE_METADATA_FILENAME):
                write_whole(metadata, b"{}")
        publish(partial, path)
    return f"{_ROOT}={out} and minari.load_dataset({name!r})"


def _env_spec(settings: DataSettings) -> EnvSpec | None:
    """What Minari recovers the environment from: with the arguments and the time limit.

    None for one that was registered with a function or a class of a script, as only a name in a
    module can be written down. None, too, for imported data of one that isn't there, and where
    observations are others than what the environment gives: by offsets, or by what is seen of it.
    """
    task = settings.task
    if task.view or task.offset.any():
        return None
    try:
        spec = copy.deepcopy(spec_of(task))
    except (InputError, ModuleNotFoundError):
        if settings.is_imported:
            return None
        raise
    spec.kwargs.update(task.arguments)
    spec.max_episode_steps = task.max_episode_steps
    if callable(maker := spec.entry_point):
        path, module = getattr(maker, "__qualname__", "."), getattr(maker, "__module__", "__main__")
        spec.entry_point = None if "." in path or module == "__main__" else f"{module}:{path}"
    return spec if spec.entry_point else None


def _buffers(dataset: Dataset) -> Iterator[EpisodeBuffer]:
    for number in Progress(range(len(dataset.episodes["length"])), unit="episode", desc="minari"):
        episode = dataset.episode(number)
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
