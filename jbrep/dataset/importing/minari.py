"""Importing a Minari data set, from its folder or by its id."""

import json
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import minari.dataset.minari_storage as storages
import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten
from numpy.typing import NDArray

from jbrep.dataset.importing.arrays import check_ends, check_lengths, label
from jbrep.dataset.importing.episodes import (
    Incoming,
    Source,
    check_kinds,
    incoming,
)
from jbrep.dataset.schema import UNKNOWN_SEED
from jbrep.envs.description import describe, features_of
from jbrep.envs.task import Task
from jbrep.errors import InputError, kind_and_line
from jbrep.records.storage import exists, read_regular

Array = NDArray[Any]
_ROOT = "MINARI_DATASETS_PATH"
_METADATA = "metadata.json"
_MAX_BYTES = 1 << 24  # of the metadata
_MOST_SHOWN = 10  # ids of data sets


def open_data_set(given: str) -> Source:
    """Open a Minari data set.

    Args:
        given: its folder, or its id, to be looked for where Minari keeps its data sets.

    Raises:
        InputError: there is none, or it holds what can't be imported.
    """
    folder = _folder(given)
    metadata = _metadata(folder)
    storage = _storage(given, folder)
    name = f"Minari {metadata.get('dataset_id', given)}"
    features = tuple(features_of(name, storage.observation_space))
    actions = _continuous(name, storage.action_space)
    env_id, arguments, limit = _environment(metadata)
    task, why_not = _describe(env_id, arguments, limit)
    identity = env_id or label(name)
    if task and (task.size, task.action_size) != (len(features), actions.low.size):
        task, identity, why_not = None, label(name), f"{env_id} has other sizes"

    def episodes() -> Iterator[Incoming]:
        return _episodes(name, storage)

    return Source(
        name,
        identity,
        episodes,
        task=task,
        features=features,
        action_bounds=(actions.low.ravel(), actions.high.ravel()),
        max_episode_steps=limit,
        why_no_task=why_not,
    )


def _continuous(name: str, space: spaces.Space[Any]) -> spaces.Box:
    if not isinstance(space, spaces.Box):
        raise InputError(f"{name} has actions in {space}: only continuous ones are possible")
    check_kinds(name, {"action": (space.dtype, space.shape)})
    return space


def _folder(given: str) -> Path:
    """The folder with a data set's metadata."""
    root = Path(os.environ.get(_ROOT) or Path.home() / ".minari" / "datasets")
    for folder in (Path(given), Path(given) / "data", root / given / "data"):
        if exists(folder / _METADATA):
            return folder
    there = sorted(path.parents[1] for path in root.glob(f"**/data/{_METADATA}"))
    names = [path.relative_to(root).as_posix() for path in there]
    shown = ", ".join(names[:_MOST_SHOWN]) + (", ..." if len(names) > _MOST_SHOWN else "")
    raise InputError(
        f"{given} is no .npz or .parquet file, and no Minari data set: it must be a path, or an id "
        f"in {root} ({_ROOT}), where there {f'are {shown}' if names else 'is none'}"
    )


def _metadata(folder: Path) -> dict[str, Any]:
    """What the data set says of itself.

    Raises:
        InputError: it can't be read, or lacks its spaces: Minari would make the environment, which
            can run code that the data set names.
    """
    path = folder / _METADATA
    try:
        metadata = json.loads(read_regular(path, _MAX_BYTES))
        spaces_of = [metadata["observation_space"], metadata["action_space"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} can't be read: {kind_and_line(error)}") from None
    if not all(isinstance(space, str) for space in spaces_of):
        raise InputError(f"{path} doesn't say what observations and actions are")
    return dict(metadata)


def _storage(given: str, folder: Path) -> storages.MinariStorage:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return storages.MinariStorage.read(folder)
    except ModuleNotFoundError:
        raise
    except Exception as error:  # whatever Minari raises
        raise _unreadable(given, error) from None


def _unreadable(name: str, error: Exception) -> InputError:
    return InputError(f"{name} can't be read as a Minari data set: {kind_and_line(error)}")


def _environment(metadata: dict[str, Any]) -> tuple[str, dict[str, Any], int | None]:
    """Id, arguments and time limit of the environment; an empty id if none is named."""
    try:
        spec = json.loads(metadata["env_spec"])
        env_id, arguments, limit = spec["id"], spec["kwargs"], spec["max_episode_steps"]
    except (KeyError, ValueError, TypeError, RecursionError):
        return "", {}, None
    if not isinstance(env_id, str) or not isinstance(arguments, dict):
        return "", {}, None
    return env_id, arguments, limit if type(limit) is int and limit > 0 else None


def _describe(env_id: str, arguments: dict[str, Any], limit: int | None) -> tuple[Task | None, str]:
    """The task, if its environment can be made here, or why not."""
    if not env_id:
        return None, "it names no environment"
    try:
        return describe(env_id, arguments, limit), ""
    except (InputError, ModuleNotFoundError) as error:
        return None, kind_and_line(error)


def _episodes(name: str, storage: storages.MinariStorage) -> Iterator[Incoming]:
    numbers = range(storage.total_episodes)
    given = zip(numbers, _read(name, storage), strict=True)
    for number, (episode, seed) in given:
        where = f"{name}: episode {number}"
        checked = _checked(where, episode, storage, seed)
        if checked is not None:
            yield checked


def _read(name: str, storage: storages.MinariStorage) -> Iterator[tuple[dict[str, Any], int]]:
    """Each episode, and its seed."""
    numbers = range(storage.total_episodes)
    try:
        pairs = zip(
            storage.get_episodes(numbers), storage.get_episode_metadata(numbers), strict=True
        )
        for episode, metadata in pairs:
            seed = metadata.get("seed")
            yield episode, UNKNOWN_SEED if seed is None else int(seed)
    except Exception as error:  # whatever Minari and HDF5 raise at damaged files
        raise _unreadable(name, error) from None


def _checked(
    where: str, episode: dict[str, Any], storage: storages.MinariStorage, seed: int
) -> Incoming | None:
    observation = _flat(where, storage.observation_space, episode["observations"])
    action = _flat(where, storage.action_space, episode["actions"])
    arrays = {n: np.asarray(episode[f"{n}s"]) for n in ("reward", "termination", "truncation")}
    check_lengths(where, {"action": len(action), **{n: len(v) for n, v in arrays.items()}})
    if len(observation) not in (len(action), len(action) + 1):
        raise InputError(
            f"{where} has {len(observation):,} observations and {len(action):,} actions: there "
            "must be one more, the final one"
        )
    check_ends(where, arrays["termination"], arrays["truncation"])
    steps = len(action)
    return incoming(
        where,
        observation[:steps],
        action,
        arrays["reward"],
        observation[steps] if len(observation) > steps else None,
        bool(arrays["termination"][-1:].any()),
        seed,
    )


def _flat(where: str, space: spaces.Space[Any], values: Any) -> Array:
    """Observations as Gymnasium flattens them, (n, ...) to (n, d)."""
    try:
        if isinstance(space, spaces.Dict):
            parts = [_flat(where, part, values[key]) for key, part in space.spaces.items()]
            return np.concatenate(parts, axis=1)
        if isinstance(space, spaces.Tuple):
            pairs = zip(space.spaces, values, strict=True)
            return np.concatenate([_flat(where, *pair) for pair in pairs], axis=1)
        array = np.asarray(values)
        if isinstance(space, spaces.Box):
            return array.reshape(len(array), int(np.prod(space.shape)))
        flat = [flatten(space, value) for value in array]
        return np.array(flat).reshape(len(array), spaces.utils.flatdim(space))
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise InputError(f"{where} doesn't fit {space}: {kind_and_line(error)}") from None
