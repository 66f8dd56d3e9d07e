"""Gymnasium environments seen through an encoder."""

import json
from collections.abc import Iterator
from typing import Any, overload

import gymnasium
import numpy as np
from gymnasium import spaces, wrappers
from gymnasium.spaces.utils import flatdim
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorObservationWrapper, VectorWrapper
from gymnasium.vector.utils import batch_space, iterate
from numpy.typing import NDArray

from jbrep.encoders.base import BaseEncoder, Float32
from jbrep.encoders.shipped import find
from jbrep.envs.description import as_task, describe
from jbrep.envs.make import flattener
from jbrep.envs.names import find_spec
from jbrep.envs.task import Task
from jbrep.errors import InputError

_Env = gymnasium.Env[Any, Any]
_VectorEnv = VectorEnv[Any, Any, Any]

_CHANGING = (gymnasium.ObservationWrapper, VectorObservationWrapper)
_KEEPING = (  # of these, those that leave the numbers as they are
    *(wrappers.FlattenObservation, wrappers.ReshapeObservation, wrappers.DtypeObservation),
    wrappers.vector.FlattenObservation,
    wrappers.vector.ReshapeObservation,
    wrappers.vector.DtypeObservation,
)
_NO_ARGUMENTS = {  # what `make` and `make_vec` take besides a task's own arguments
    *("render_mode", "camera", "camera_name", "camera_id", "width", "height", "form", "dtype"),
    *("num_envs", "num_threads", "vectorization_mode", "autoreset_mode", "max_episode_steps"),
    *("vector_kwargs", "wrappers", "scaled", "default_camera_config", "max_geom", "visual_options"),
}


class Encoded:
    """An environment whose observations are an encoder's latents, terminal ones too.

    It is a `gymnasium.Wrapper`, or a `gymnasium.vector.VectorWrapper` of a vector environment,
    whose `infos["final_obs"]` holds latents, too. The encoder gets float32 observations in physical
    units, (n, d), flat in the order of Gymnasium's `flatten`, less the task's offsets.

    Args:
        env: the environment.
        encoder: whatever `jbrep.encoders.find` takes: a name, a file, an object that encodes or a
            torch module.
        task: whose observations these are, or its name; described from the environment's spec if
            not given. One that is given is taken at its word, but for its number of features.

    Attributes:
        encoder: the encoder.
        task: whose observations it reads.
    """

    encoder: BaseEncoder
    task: Task

    @overload
    def __new__(cls, env: _Env, encoder: Any, task: Task | str | None = None) -> "EncodedEnv": ...

    @overload
    def __new__(
        cls, env: _VectorEnv, encoder: Any, task: Task | str | None = None
    ) -> "EncodedVectorEnv": ...

    def __new__(cls, env: Any = None, encoder: Any = None, task: Any = None) -> Any:
        """Make the wrapper that suits the environment; a copy comes without one."""
        if cls is Encoded:
            cls = EncodedVectorEnv if isinstance(env, VectorEnv) else EncodedEnv
        return super().__new__(cls)

    def _read(self, env: Any, space: spaces.Space[Any], encoder: Any, task: Any) -> Any:
        """Find task and encoder; the space of latents, for observations in a space."""
        if getattr(env.unwrapped, "scaled", False):
            raise InputError(
                "the environment's observations are scaled already, but encoders take physical "
                "units: make it with scaled=False"
            )
        self.task = _described(env) if task is None else as_task(task)
        if (size := flatdim(space)) != self.task.size:
            raise InputError(
                f"the environment's observations have {size} numbers, where {self.task.name} has "
                f"{self.task.size}: give the task that describes them"
            )
        self._flat = flattener(space)
        self.encoder = find(encoder, self.task)
        return spaces.Box(-np.inf, np.inf, (self.encoder.latent_size,), np.float32)

    def _encode(self, rows: NDArray[Any]) -> Float32:
        return self.encoder.encode((rows - self.task.offset).astype(np.float32))


class EncodedEnv(Encoded, gymnasium.Wrapper[Float32, Any, Any, Any], RecordConstructorArgs):
    """A single environment, see `Encoded`."""

    def __init__(self, env: _Env, encoder: Any, task: Task | str | None = None):
        RecordConstructorArgs.__init__(self, encoder=encoder, task=task, _disable_deepcopy=True)
        gymnasium.Wrapper.__init__(self, env)
        self.observation_space = self._read(env, env.observation_space, encoder, task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._latent(observation), info

    def step(self, action: Any) -> tuple[Float32, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._latent(observation), reward, terminated, truncated, info

    def _latent(self, observation: Any) -> Float32:
        return self._encode(self._flat(observation)[None])[0]


class EncodedVectorEnv(Encoded, VectorWrapper[Float32, Any, Any, Any, Any]):
    """A vector environment, see `Encoded`."""

    def __init__(self, env: _VectorEnv, encoder: Any, task: Task | str | None = None):
        VectorWrapper.__init__(self, env)
        single = self._read(env, env.single_observation_space, encoder, task)
        self.single_observation_space = single
        self.observation_space = batch_space(single, env.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        observation, infos = self.env.reset(seed=seed, options=options)
        return self._encode(self._rows(observation)), infos

    def step(self, actions: Any) -> tuple[Float32, Any, Any, Any, dict[str, Any]]:
        observation, reward, terminated, truncated, infos = self.env.step(actions)
        if "final_obs" in infos:
            infos = {**infos, "final_obs": self._finals(infos["final_obs"], infos["_final_obs"])}
        return self._encode(self._rows(observation)), reward, terminated, truncated, infos

    def _finals(self, finals: Any, ended: NDArray[np.bool_]) -> NDArray[Any]:
        """The latent of each environment that ended, (n,) of objects as Gymnasium gives them."""
        represented, indices = np.full(len(ended), None, object), np.flatnonzero(ended).tolist()
        if indices:
            latents = self._encode(np.stack([self._flat(finals[index]) for index in indices]))
            for index, latent in zip(indices, latents, strict=True):
                represented[index] = latent
        return represented

    def _rows(self, observation: Any) -> NDArray[Any]:
        if isinstance(self.env.single_observation_space, spaces.Box):
            return observation.reshape(len(observation), -1)
        each = iterate(self.env.observation_space, observation)
        return np.stack([self._flat(one) for one in each])


def _described(env: Any) -> Task:
    for each in _wrappers(env):
        changed = isinstance(each, _CHANGING) and not isinstance(each, _KEEPING)
        if changed or isinstance(each, Encoded):
            raise InputError(
                f"{type(each).__name__} changes the environment's observations: wrap the "
                "environment in Encoded first, or give the task that describes them"
            )
    spec = env.spec or env.unwrapped.spec
    if spec is None:
        raise InputError("an environment without a spec doesn't say its task: give task=...")
    registered = find_spec(spec.id).kwargs
    arguments = {
        name: value
        for name, value in spec.kwargs.items()
        if name not in _NO_ARGUMENTS and not (name in registered and registered[name] == value)
    }
    try:
        json.dumps(arguments)
    except TypeError:
        raise InputError(
            f"{spec.id} has arguments that can't be described: give the task"
        ) from None
    return describe(
        spec.id, arguments, spec.kwargs.get("max_episode_steps", spec.max_episode_steps)
    )


def _wrappers(env: Any) -> Iterator[Any]:
    """The wrappers of an environment, and those of the first of several."""
    while isinstance(env, (gymnasium.Wrapper, VectorWrapper)):
        yield env
        env = env.env
    for first in getattr(env, "envs", ())[:1]:
        yield from _wrappers(first)
