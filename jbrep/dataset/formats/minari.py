"""Data sets in Minari's HDF5 storage, with the environment that it recovers.

They may be strangers': nothing outside their folder is read, and no environment is made with
arguments that may name files. What jbrep exports has the checksums of its files beside them.
"""

import copy
import hashlib
import json
import os
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import minari
import minari.dataset.minari_storage as storages
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces.utils import flatten
from minari.data_collector import EpisodeBuffer
from minari.namespace import NAMESPACE_METADATA_FILENAME
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

import jbrep.jitterbug.simulation  # noqa: F401  Minari makes the environment: load MuJoCo before
from jbrep.dataset.formats.episodes import Incoming, Source, check_kind, label, whole_episode
from jbrep.dataset.formats.hdf5 import opened
from jbrep.dataset.reader import Dataset
from jbrep.dataset.rewards import without_range
from jbrep.dataset.schema import UNKNOWN_SEED, DataSettings
from jbrep.envs.description import describe
from jbrep.envs.names import spec_of
from jbrep.envs.probe import features_of
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError, kind_and_line, listed, refusing
from jbrep.progress import Progress
from jbrep.records.document import Document, read_document
from jbrep.records.record import Finite, Sha256
from jbrep.records.storage import (
    exists,
    make_folder,
    publish,
    read_file,
    unfinished,
    write_whole,
)

Array = NDArray[Any]
_ROOT = "MINARI_DATASETS_PATH"  # Minari takes the folder of its data sets from there only
_METADATA, _CHECKSUMS = "metadata.json", "jbrep.json"
_WORD = re.compile(r"[\w-]{1,40}")
EPISODE_BYTES = 1 << 14  # that HDF5 takes for each episode besides its rows


class Checksums(Document, frozen=True, kw_only=True):
    """jbrep.json: the SHA-256 of each file that was exported, by its name, and what Minari lacks.

    That is the offsets of features, (d,), and whether the rewards aren't the environment's.
    """

    format = "jbrep export"
    format_version = 2

    files: Mapping[str, Sha256]
    offsets: tuple[Finite, ...] = ()
    own_rewards: Literal[True] | UnsetType = UNSET


def open_source(given: str) -> Source:
    """Open a Minari data set.

    Args:
        given: its folder, or its id, to be looked for where Minari keeps its data sets.

    Raises:
        DamageError: it isn't what jbrep exported.
    """
    folder = _folder(given)
    exported = _check_files(folder)
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
    if task and exported and exported.own_rewards:
        task = without_range(task)
    return Source(
        name,
        identity,
        lambda: _episodes(name, storage),
        task=task,
        features=features,
        action_bounds=(actions.low.ravel(), actions.high.ravel()),
        max_episode_steps=limit,
        why_no_task=why_not,
        subtracted=np.array(exported.offsets) if exported and exported.offsets else 0.0,
    )


def _continuous(name: str, space: spaces.Space[Any]) -> spaces.Box:
    if not isinstance(space, spaces.Box):
        raise InputError(f"{name} has actions in {space}: only continuous ones are possible")
    check_kind(name, "action", space.dtype, space.shape)
    return space


def _folder(given: str) -> Path:
    """The folder with a data set's metadata."""
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


def _check_files(folder: Path) -> Checksums | None:
    """Make sure that all files are inside the folder, and as jbrep exported them, if so.

    Raises:
        DamageError: one isn't what was exported.
    """
    known = read_document(folder / _CHECKSUMS, Checksums) if exists(folder / _CHECKSUMS) else None
    if known:
        for name, sha256 in known.files.items():
            if _sha256(folder / name) != sha256:
                raise DamageError(
                    f"{folder / name} is damaged: it isn't what was exported, by its checksum; "
                    "export the data set again"
                )
    for path in sorted(folder.rglob("*.hdf5")):
        with opened(path, whole=True):
            pass
    return known


def _sha256(path: Path) -> str:
    """Of a file; empty where there is none."""
    return hashlib.sha256(read_file(path)).hexdigest() if exists(path) else ""


def _metadata(folder: Path) -> dict[str, Any]:
    """What the data set says of itself."""
    path = folder / _METADATA
    raw = read_file(path)
    with refusing(f"{path} can't be read", (ValueError, KeyError, TypeError, RecursionError)):
        metadata = json.loads(raw)
        spaces_of = [metadata["observation_space"], metadata["action_space"]]
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
    if not _is_harmless(arguments):
        return None, f"the arguments of {env_id} may name files, so that it isn't made"
    try:
        return describe(env_id, arguments, limit), ""
    except (InputError, ModuleNotFoundError) as error:
        return None, kind_and_line(error)


def _is_harmless(value: Any) -> bool:
    """Whether an argument of a stranger's can't name a file: numbers and words."""
    if isinstance(value, dict):
        return all(map(_is_harmless, (*value, *value.values())))
    if isinstance(value, list):
        return all(map(_is_harmless, value))
    return not isinstance(value, str) or bool(_WORD.fullmatch(value) and not exists(value))


def _episodes(name: str, storage: storages.MinariStorage) -> Iterator[Incoming]:
    for number, (episode, seed) in enumerate(_read(name, storage)):
        where = f"{name}: episode {number}"
        given = {
            "action": _flat(where, storage.action_space, episode["actions"]),
            "observation": _flat(where, storage.observation_space, episode["observations"]),
            "reward": episode["rewards"],
            "terminated": episode["terminations"],
            "truncated": episode["truncations"],
        }
        yield from whole_episode(where, given, seed=seed)


def _read(name: str, storage: storages.MinariStorage) -> Iterator[tuple[dict[str, Any], int]]:
    """Each episode, and its seed."""
    try:
        numbers = range(storage.total_episodes)
        pairs = zip(
            storage.get_episodes(numbers), storage.get_episode_metadata(numbers), strict=True
        )
        for episode, metadata in pairs:
            seed = metadata.get("seed")
            yield episode, UNKNOWN_SEED if seed is None else int(seed)
    except Exception as error:  # whatever Minari and HDF5 raise at damaged files
        raise _unreadable(name, error) from None


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


def write(dataset: Dataset, out: Path) -> str:
    """Add a data set to a folder of Minari data sets; returns how to open it."""
    settings = dataset.manifest.settings
    name = f"{_namespace(settings.task)}/{settings.policy['kind']}-v0"
    path, spec = out / name, _env_spec(settings)
    dataset["reward"]  # says what to do if there are none
    make_folder(path.parent)
    with unfinished(path) as root:  # Minari ignores hidden folders
        root.mkdir()
        with _datasets_in(root.resolve()), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on the missing author and address
            _create(dataset, name, spec)
        _write_checksums(root / name / "data", settings)
        for namespace in Path(name).parents[:-1]:
            metadata = namespace / NAMESPACE_METADATA_FILENAME
            if not exists(out / metadata):
                write_whole(out / metadata, (root / metadata).read_bytes())
        publish(root / name, path)
    return f"{_ROOT}={out} and minari.load_dataset({name!r})"


def _write_checksums(folder: Path, settings: DataSettings) -> None:
    files = {path.name: _sha256(path) for path in sorted(folder.iterdir())}
    offsets = tuple(settings.task.offset.tolist()) if settings.task.offset.any() else ()
    known = Checksums(files=files, offsets=offsets, own_rewards=True if settings.reward else UNSET)
    known.write(folder / _CHECKSUMS)


def _namespace(task: Task) -> str:
    """Jitterbug's tasks stand together; another's name has no version there."""
    name = f"jitterbug/{task.slug}" if task.id.startswith("Jitterbug/") else task.name
    name = re.sub(r"[^A-Za-z0-9_/-]+", "-", name)
    return name if len(name) > 1 else f"task-{name}"  # Minari takes no single letter


def _create(dataset: Dataset, name: str, spec: EnvSpec | None) -> None:
    settings, versions = dataset.manifest.settings, dataset.manifest.versions
    task = settings.task
    low, high = (np.array(ends, np.float32) for ends in (task.action_low, task.action_high))
    minari.create_dataset_from_buffers(
        name,
        _buffers(dataset),
        env=spec,
        observation_space=spaces.Box(-np.inf, np.inf, (task.size,), np.float32),
        action_space=spaces.Box(low, high, dtype=np.float32),
        algorithm_name=settings.policy["kind"],
        description=f"{json.dumps(settings.as_json())} {dataset.fingerprint}",
        requirements=[f"{package}=={versions[package]}" for package in ("jbrep", "mujoco")],
    )


def _env_spec(settings: DataSettings) -> EnvSpec | None:
    """What Minari recovers the environment from: with the arguments and the time limit.

    None for one that was registered with a class or function: only a name can be written down.
    None, too, for imported data of one that isn't there, and where observations are others than
    what the environment gives: by offsets, or by what is seen of it.
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
