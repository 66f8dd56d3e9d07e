"""Environments whose sensors, motors, bodies and physics each episode draws."""

import copy
from collections.abc import Mapping
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from jbrep.envs.domain import Domain, Drawn, Draws
from jbrep.envs.physics import FRICTIONS, MASSES, physics_of, put_factors, velocity_after
from jbrep.envs.task import Array, Task

_OPTIONS = ("friction", "mass", "body")  # of a batch that has them, when it is reset


class Disturbed:
    """A batch of environments, as `Environments` steps one, as a task's domain has it.

    What an episode draws follows from its seed, and what a step draws from its number, too. What of
    the physics is drawn, the batch does itself, or else takes it as options of `reset` and in
    `push`.
    """

    def __init__(self, batch: Any, task: Task, num_envs: int):
        assert task.domain
        self._batch, self._task, self._domain = batch, task, task.domain
        whole = task.whole
        self._draws = Draws(num_envs, whole.size)
        self._push = getattr(batch, "push", None)
        self._options = _OPTIONS[: 3 if task.domain.body else 2]
        self._spread = np.array(task.domain.spread or np.zeros(whole.size))
        turns = [f.is_full_turn for f in whole.features]
        self._turns = np.flatnonzero(turns)
        self._low = np.array([f.low for f in whole.features if f.is_full_turn])
        self._rest, delays = whole.rest, (task.domain.delay[1], task.domain.action_delay[1])
        self._drawn: dict[str, Array] = {n: np.zeros(num_envs) for n in Drawn._fields}
        self._measured = np.zeros((num_envs, delays[0] + 1, whole.size))  # the latest first
        self._commands = np.zeros((num_envs, delays[1] + 1, whole.action_size))
        self._shown = np.zeros((num_envs, whole.size))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._batch, name)

    def reset(self, seed: Any, options: Mapping[str, Any]) -> tuple[Array, Any]:
        indices = np.flatnonzero(options["reset_mask"])
        seeds = np.array([seed[index] for index in indices], np.int64)
        self._draws.begin(indices, seeds)
        self._draw(indices, seeds)
        drawn = {name: self._drawn[name] for name in self._options} if self._push else {}
        given, info = self._batch.reset(seed=seed, options={**options, **drawn})
        self._measured[indices] = self._measure(given)[indices, None]
        self._shown[indices] = self._measured[indices, 0]
        self._commands[indices] = self._rest
        return self._shown.copy(), info

    def _draw(self, indices: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        for index, seed in zip(indices.tolist(), seeds.tolist(), strict=True):
            for name, value in self._domain.draw(seed)._asdict().items():
                self._drawn[name][index] = 0 if value is None else value

    def step(self, actions: Array) -> tuple[Any, ...]:
        self._draws.move()
        if self._push and (pushes := self._draws.pushes(self._drawn["push"])).any():
            self._push(pushes)
        _put_first(self._commands, actions)
        given, *others = self._batch.step(self._late(self._commands, "action_delay"))
        arrived = self._draws.uniform >= self._drawn["dropped"]
        if hasattr(self._batch, "lost"):
            arrived &= ~self._batch.lost
        _put_first(self._measured, self._measure(given))
        late = self._late(self._measured, "delay")
        self._shown = np.where(arrived[:, None], late, self._shown)
        return self._shown.copy(), *others

    def _measure(self, given: Array) -> Array:
        """What sensors say, (n, d): an environment without noise has what is given, to the bit."""
        noise = self._drawn["noise"][:, None]
        noisy = given + noise * self._spread * self._draws.normal
        turns = noisy[:, self._turns]
        noisy[:, self._turns] = self._low + np.mod(turns - self._low, 2 * np.pi)
        return np.where(noise > 0, noisy, given)

    def _late(self, values: Array, name: str) -> Array:
        return values[np.arange(len(values)), self._drawn[name].astype(np.int64)]


def _put_first(values: Array, newest: Array) -> None:
    """Put the newest (n, ...) before those of earlier steps, (n, k, ...); the oldest goes."""
    values[:, 1:] = values[:, :-1].copy()
    values[:, 0] = newest


class Varied(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment with MuJoCo, whose friction, masses and pushes each episode draws.

    Frictions and masses that the environment itself sets in its reset are multiplied likewise.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], domain: Domain):
        super().__init__(env)
        self._domain, self._draws = domain, Draws(1, 0)
        self._model: Any = None
        self._speed = np.zeros(1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the episode with that seed."""
        assert seed is not None
        drawn = self._domain.draw(seed)
        self._speed[:] = drawn.push
        self._draws.begin(np.array([0]), np.array([seed]))
        self._vary(drawn.friction, drawn.mass)
        put = {name: getattr(self._model, name).copy() for name in (*FRICTIONS, *MASSES)}
        given = self.env.reset(seed=seed, options=options)
        self._keep(put)
        self._vary(drawn.friction, drawn.mass)  # it may have another model now
        return given

    def _keep(self, put: dict[str, Array]) -> None:
        """Take the numbers that the environment changed since they were put there as the usual."""
        for name, before in put.items():
            now, usual = getattr(self._model, name), getattr(self._usual, name)
            usual[:] = np.where(now == before, usual, now)

    def _vary(self, friction: float, mass: float) -> None:
        physics = physics_of(self.env)
        assert physics  # as `jbrep.envs.description.changeable` has seen
        if physics.model is not self._model:
            self._model, self._usual = physics.model, copy.copy(physics.model)
            self._data = mujoco.MjData(self._usual)
        put_factors(self._model, self._usual, friction, mass, self._data)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step, after a push if there is one."""
        self._draws.move()
        (push,) = self._draws.pushes(self._speed)
        if push.any():
            physics = physics_of(self.env)
            assert physics
            now = physics.data.qpos
            physics.data.qvel[:] += velocity_after(physics.model, now, push, self._data)
        return self.env.step(action)
