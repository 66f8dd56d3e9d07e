"""Making a task's environment: one instance with a flat observation, or a batch of many.

A robot may exist once: one environment that nobody uses is kept for the next who asks for it, so
that describing, collecting and evaluating in turn have the same instance. All are closed at the
end, whatever happens.
"""

import atexit
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.spaces.utils import flatten
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from jbrep.envs.disturbed import Varied
from jbrep.envs.domain import Domain
from jbrep.envs.isolation import isolated
from jbrep.envs.names import INSTANCE, files_of, find_spec, spec_of
from jbrep.envs.task import Task
from jbrep.errors import InputError, Notice, kind_and_line, refusing

Env = gymnasium.Env[Any, Any]
Flatten = Callable[[Any], NDArray[Any]]
_Key = tuple[Any, ...]
_NO_LIMIT = -1  # as gymnasium.make takes it


def make_env(
    env_id: str, arguments: Mapping[str, Any], max_episode_steps: int | None = None
) -> Env:
    """One instance, as Gymnasium makes it; without a time limit it has the registered one."""
    spec = find_spec(env_id)
    with _making(env_id, arguments):
        return gymnasium.make(spec, max_episode_steps, disable_env_checker=True, **arguments)


def make_batch(task: Task, num_envs: int, num_threads: int | None) -> VectorEnv[Any, Any, Any]:
    """All of them as one environment that steps them together, see `is_batched`."""
    with _making(task.id, task.arguments):
        return gymnasium.make_vec(
            spec_of(task),
            num_envs=num_envs,
            vectorization_mode="vector_entry_point",
            autoreset_mode=AutoresetMode.DISABLED,
            max_episode_steps=task.max_episode_steps,
            num_threads=num_threads,
            dtype="float64",
            **task.arguments,
        )


@contextmanager
def _making(env_id: str, arguments: Mapping[str, Any]) -> Iterator[None]:
    given = f" with {dict(arguments)}" if arguments else ""
    with refusing(f"can't make {env_id}{given}"), _quiet(), isolated():
        yield


def is_batched(task: Task) -> bool:
    """Whether many environments are stepped faster together than one by one.

    That is so if the registered vector entry point is a class that says so: one with a true
    attribute `resets_envs`, the arguments num_threads, dtype and autoreset_mode, and a `reset`
    that takes the option `reset_mask`.
    """
    return getattr(creator(spec_of(task), vector=True), "resets_envs", False)


def is_one_robot(task: Task, threads: int | None) -> bool:
    """Whether only one instance of the environment may be made, as of a robot that exists once."""
    return task.id.startswith(INSTANCE) or (threads == 1 and not is_batched(task))


def creator(spec: EnvSpec, vector: bool = False) -> Any:
    """The class or function that makes the environment; None if there is none."""
    entry_point = spec.vector_entry_point if vector else spec.entry_point
    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


def flattener(space: spaces.Space[Any]) -> Flatten:
    """What `gymnasium.spaces.utils.flatten` does for a space, made once instead of at each step."""
    if isinstance(space, spaces.Box):
        return np.ravel
    if isinstance(space, spaces.Dict):
        parts = [(key, flattener(part)) for key, part in space.spaces.items()]
        return lambda given: np.concatenate([flat(given[key]) for key, flat in parts])
    if isinstance(space, spaces.Tuple):
        each = [flattener(part) for part in space.spaces]
        return lambda given: np.concatenate([f(part) for f, part in zip(each, given, strict=True)])
    return lambda given: np.asarray(flatten(space, given))


def action_in(space: Any, values: Any) -> NDArray[Any]:
    """An action in a space, a Box: a new array of its shape and type, of numbers (k,)."""
    return np.array(values, space.dtype).reshape(space.shape)


def of_size(flat: NDArray[Any], size: int) -> NDArray[Any]:
    """An observation, flat, that has so many numbers, or a ValueError."""
    if flat.shape != (size,):
        raise ValueError(f"it gave an observation of {flat.size} numbers instead of {size}")
    return flat


def number(value: Any, what: str) -> float:
    """One number that an environment gives, which may stand in an array, or a ValueError."""
    if isinstance(value, float | int):
        return float(value)
    values = np.asarray(value)
    if values.size != 1:
        raise ValueError(f"it gave a {what} of shape {values.shape}: it must be one number")
    return float(values.item())


@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings of newer versions, of spaces without bounds, of deprecated models."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


# the environments that this process has open


class _Instance(NamedTuple):
    key: _Key  # what it is
    env: Env
    given: Mapping[str, Any]  # its arguments
    files: Mapping[str, str] = {}  # hashes of those that they name, when it was last used


_used: dict[int, _Instance] = {}  # by the identity of what was lent
_kept: list[_Instance] = []  # one at most


def take(
    env_id: str,
    arguments: Mapping[str, Any],
    max_episode_steps: int | None = None,
    domain: Domain | None = None,
) -> Env:
    """An environment to use: the one that is kept, if it is the same, or else a new one."""
    if env_id.startswith(INSTANCE) and any(each.key[0] == env_id for each in _used.values()):
        raise InputError(f"{env_id} exists once, and is in use: for several, give its class")
    spec = find_spec(env_id)
    given = {**spec.kwargs, **arguments}
    key = spec.id, creator(spec), repr(given), domain
    limit = max_episode_steps or spec.max_episode_steps
    bare = _take_kept(key, given)
    if bare is None:
        bare = make_env(env_id, arguments, _NO_LIMIT)
        bare = Varied(bare, domain) if domain else bare
    env = TimeLimit(bare, limit) if limit else bare
    _used[id(env)] = _Instance(key, bare, given)
    return env


def _take_kept(key: _Key, given: Mapping[str, Any]) -> Env | None:
    """The kept one if it is that; another is closed, since it may have what a new one needs."""
    if not _kept:
        return None
    kept = _kept.pop()
    if kept.key == key and kept.files == files_of(given):
        return kept.env
    _close(kept.env)
    return None


def give_back(env: Env) -> None:
    """Keep an environment that is no longer used, in place of the one before."""
    if used := _used.pop(id(env), None):
        close_kept()
        _kept.append(used._replace(files=files_of(used.given)))  # which it may have written


def discard(env: Env) -> None:
    """Close an environment that failed."""
    if used := _used.pop(id(env), None):
        _close(used.env)


def close_kept() -> None:
    """Close what nobody uses, so that another process can have it."""
    while _kept:
        _close(_kept.pop().env)


@atexit.register
def close_all() -> None:
    """Close every environment, used or not; at the end it matters to nobody whether one fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        close_kept()
        while _used:
            _close(_used.popitem()[1].env)


def _close(env: Env) -> None:
    try:
        with isolated():
            env.close()
    except Exception as error:
        warnings.warn(f"an environment can't be closed: {kind_and_line(error)}", Notice, 2)
