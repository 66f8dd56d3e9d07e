"""Making a task's environment: one instance with a flat observation, or a batch of many."""

import logging
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.spaces.utils import flatten
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from jbrep.envs.names import find_spec, spec_of
from jbrep.envs.task import Task
from jbrep.errors import refusing

Flatten = Callable[[Any], NDArray[Any]]


def make_env(
    env_id: str, arguments: Mapping[str, Any], max_episode_steps: int | None = None, **options: Any
) -> gymnasium.Env[Any, Any]:
    """One instance, as Gymnasium makes it.

    Args:
        env_id: in the registry, or a short name.
        arguments: of the environment.
        max_episode_steps: the time limit; None takes the registered one.
        options: more arguments, such as render_mode.
    """
    spec = find_spec(env_id)
    if max_episode_steps is not None:
        options["max_episode_steps"] = max_episode_steps  # None would lift the registered limit
    with _making(env_id, arguments):
        return gymnasium.make(spec, disable_env_checker=True, **{**arguments, **options})


def make_batch(task: Task, num_lanes: int, num_threads: int | None) -> VectorEnv[Any, Any, Any]:
    """All lanes as one environment that steps them together, see `is_batched`."""
    with _making(task.id, task.arguments):
        return gymnasium.make_vec(
            spec_of(task),
            num_envs=num_lanes,
            vectorization_mode="vector_entry_point",
            autoreset_mode=AutoresetMode.DISABLED,
            max_episode_steps=task.max_episode_steps,
            num_threads=num_threads,
            dtype="float64",
            **task.arguments,
        )


@contextmanager
def _making(env_id: str, arguments: Mapping[str, Any]) -> Iterator[None]:
    """Say in a line why an environment can't be made."""
    given = f" with {dict(arguments)}" if arguments else ""
    with refusing(f"can't make {env_id}{given}"), _quiet(), aside():
        yield


def is_batched(task: Task) -> bool:
    """Whether the environment steps many lanes faster together than one by one.

    That is so if the registered vector entry point is a class that says so: one with a true
    attribute `resets_lanes`, the arguments num_threads, dtype and autoreset_mode, and a `reset`
    that takes the option `reset_mask`.
    """
    return getattr(creator(spec_of(task), vector=True), "resets_lanes", False)


def is_one_robot(task: Task, threads: int | None) -> bool:
    """Whether only one instance of the environment may be made, as of a robot that exists once."""
    return threads == 1 and not is_batched(task)


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


def aside() -> redirect_stdout[Any]:
    """What an environment prints goes to standard error: the output is the command's own."""
    return redirect_stdout(sys.stderr)


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
