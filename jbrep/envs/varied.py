"""MuJoCo's models with other friction and masses, and robots that are pushed."""

import copy
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from jbrep.envs.domain import Domain, Draws
from jbrep.envs.mujoco import physics_of, root_of
from jbrep.envs.task import Array

_FRICTIONS, _MASSES = ("geom_friction", "pair_friction"), ("body_mass", "body_inertia")


def put_factors(
    model: mujoco.MjModel, usual: mujoco.MjModel, friction: float, mass: float, data: mujoco.MjData
) -> None:
    """Give a model the friction and the masses of another one of the same robot, times factors.

    Args:
        model: to change.
        usual: where the factors are 1.
        friction: the factor of all contacts.
        mass: that of all bodies, with their inertias.
        data: of a model of the same sizes, whose contents are lost.
    """
    for names, factor in ((_FRICTIONS, friction), (_MASSES, mass)):
        for name in names:
            getattr(model, name)[:] = factor * getattr(usual, name)
    mujoco.mj_setConst(model, data)  # what follows from masses


def velocity_after(
    model: mujoco.MjModel, qpos: Array, push: NDArray[Any], data: mujoco.MjData
) -> Array:
    """What a push adds to the velocities of a robot's joints at once, (nv,).

    Args:
        model: of the robot.
        qpos: where it is, (nq,).
        push: on the centre of mass of the body that carries all others that move, (3,): the
            impulse by the mass of these [m/s].
        data: as for `put_factors`.
    """
    can_move = (model.body_rootid == root_of(model)) & (model.body_weldid > 0)
    first = int(np.argmax(can_move * model.body_subtreemass))
    force = np.zeros(model.nv)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    impulse = model.body_subtreemass[first] * push
    mujoco.mj_applyFT(model, data, impulse, np.zeros(3), data.xipos[first], first, force)
    velocity = np.zeros((1, model.nv))
    mujoco.mj_solveM(model, data, velocity, force[None])
    return velocity[0]


def can_be_pushed(model: mujoco.MjModel) -> bool:
    """Whether a push from some side moves a robot, in its first posture or in another one."""
    data, sides, bent = mujoco.MjData(model), np.eye(3)[:2], model.qpos0.copy()
    mujoco.mj_integratePos(model, bent, np.ones(model.nv), 1)  # each joint by 1 rad or 1 m
    moved = [
        velocity_after(model, qpos, side, data) for qpos in (model.qpos0, bent) for side in sides
    ]
    return bool(np.abs(moved).max(initial=0) > 1e-6)


class Varied(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment with MuJoCo, whose friction, masses and pushes each episode draws.

    Frictions and masses that the environment itself sets in its reset are multiplied likewise.

    Args:
        env: the environment.
        domain: from which it draws.
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
        put = {name: getattr(self._model, name).copy() for name in (*_FRICTIONS, *_MASSES)}
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
        assert physics  # as `jbrep.envs.randomized.changeable` has seen
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
