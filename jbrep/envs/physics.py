"""MuJoCo behind an environment: its model and state, and how to turn, vary and push its robot."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Array

if TYPE_CHECKING:
    from jbrep.envs.environments import Environments
    from jbrep.envs.recording import Recording

FRICTIONS, MASSES = ("geom_friction", "pair_friction"), ("body_mass", "body_inertia")
# of an MjData: what a picture and the contact forces of a state follow from
_STATE = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")


class Physics(NamedTuple):
    """An environment's model and state."""

    model: mujoco.MjModel
    data: mujoco.MjData


def physics_of(env: Any) -> Physics | None:
    """The simulation behind one of Gymnasium's environments; None if it isn't MuJoCo's.

    Known are those of Gymnasium and others like them, which have `model` and `data`, and those of
    dm_control behind shimmy.
    """
    base = env.unwrapped
    for owner in (base, getattr(getattr(base, "_env", None), "physics", None)):
        model, data = (getattr(owner, name, None) for name in ("model", "data"))
        model, data = (getattr(part, "ptr", part) for part in (model, data))  # dm_control wraps
        if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
            return Physics(model, data)
    return None


def root_of(model: mujoco.MjModel) -> int:
    """The body that carries the heaviest tree of those that can move; 0 where none can."""
    roots = model.body_rootid[model.body_dofnum > 0].tolist()
    return max(roots, key=lambda body: float(model.body_subtreemass[body]), default=0)


def free_joints(model: mujoco.MjModel) -> list[int]:
    """The joints of free bodies."""
    free: list[int] = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).tolist()
    return free


def robot_joint(model: mujoco.MjModel) -> int | None:
    """The joint by which the robot is free, if it is: it is the heaviest tree."""
    root = root_of(model)
    return next((each for each in free_joints(model) if model.jnt_bodyid[each] == root), None)


def planar_root(model: mujoco.MjModel) -> tuple[int, int, int] | None:
    """The joints by which a body moves along the world's x and y and turns about z."""
    root, unturned = root_of(model), (1, 0, 0, 0)
    for body in sorted(range(1, model.nbody), key=lambda body: body != root):
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        if model.body_parentid[body] or count < 3:
            continue
        if not np.array_equal(model.body_quat[body], unturned):
            continue
        kinds = model.jnt_type[first : first + 3].tolist()
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        axes = model.jnt_axis[first : first + 3]
        if kinds == [slide, slide, hinge] and np.array_equal(axes, np.eye(3)):
            return first, first + 1, first + 2
    return None


def quarter_turn(env: gymnasium.Env[Any, Any], shift: tuple[float, float]) -> bool:
    """Turn a robot by a quarter about the world's vertical axis, then shift it [m], if it can be.

    An environment whose targets move with the robot has a method of that name; in others one body
    must be free, or move in the plane. A quarter, since MuJoCo's pyramidal friction cones are the
    same along both axes only.
    """
    if own := getattr(env.unwrapped, "quarter_turn", None):
        own(shift)
        return True
    physics = physics_of(env)
    if physics is None:
        return False
    model, data = physics
    robot = robot_joint(model)
    if any(each != robot for each in free_joints(model)):
        return False  # whether the others belong to the robot isn't known
    if robot is not None:
        place, speed = int(model.jnt_qposadr[robot]), int(model.jnt_dofadr[robot])
        quaternion = data.qpos[place + 3 : place + 7]
        quaternion[:] = turned_quaternion(quaternion)
        places, speeds = [place, place + 1], [speed, speed + 1]
    elif root := planar_root(model):
        places = model.jnt_qposadr[list(root[:2])].tolist()
        speeds = model.jnt_dofadr[list(root[:2])].tolist()
        data.qpos[model.jnt_qposadr[root[2]]] += np.pi / 2
    else:
        return False
    data.qpos[places] = turned(data.qpos[places]) + shift
    data.qvel[speeds] = turned(data.qvel[speeds])
    data.qacc_warmstart[speeds] = turned(data.qacc_warmstart[speeds])
    mujoco.mj_forward(model, data)
    return True


def turned(vectors: Array) -> Array:
    """Vectors (..., 2) of the plane, a quarter turned."""
    return np.stack((-vectors[..., 1], vectors[..., 0]), -1)


def turned_quaternion(quaternions: Array) -> Array:
    """Quaternions (..., 4), a quarter turned about the vertical axis."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack((w - z, x - y, y + x, z + w), -1) * np.sqrt(0.5)


def put_factors(
    model: mujoco.MjModel, usual: mujoco.MjModel, friction: float, mass: float, data: mujoco.MjData
) -> None:
    """Give a model the friction and the masses of the usual one of the same robot, times factors.

    The contents of `data`, of a model of the same sizes, are lost.
    """
    for names, factor in ((FRICTIONS, friction), (MASSES, mass)):
        for name in names:
            getattr(model, name)[:] = factor * getattr(usual, name)
    mujoco.mj_setConst(model, data)  # what follows from masses


def velocity_after(
    model: mujoco.MjModel, qpos: Array, push: NDArray[Any], data: mujoco.MjData
) -> Array:
    """What a push adds to the velocities of a robot's joints at once, (nv,); `data` is lost.

    The push is the impulse on the centre of mass of the body that carries all others that move, by
    the mass of these, (3,) [m/s].
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


@dataclass(frozen=True, eq=False)
class Motion:
    """The n states of MuJoCo that a robot went through."""

    model: mujoco.MjModel  # the robot and its surroundings
    # of `mujoco.MjData`, (n, ...) each; those left out are as in a new one. `ctrl` is what was held
    # in the step that led to a state
    arrays: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def qpos(self) -> Array:
        """Positions of the joints, (n, nq)."""
        return self.arrays["qpos"]

    def put(self, data: mujoco.MjData, state: int) -> None:
        """Set a data object to one of the states; nothing is computed from it."""
        for name, values in self.arrays.items():
            getattr(data, name)[:] = values[state]


class MotionReader:
    """Reads the physics while `jbrep.envs.recording.record` plays the next episodes.

    Known are the environments of `physics_of`, and batches that give their `models`
    and their `mujoco_state`, arrays of `mujoco.MjData` by name, (n, ...) each.
    """

    def __init__(self) -> None:
        self._models: list[mujoco.MjModel] = []

    def __call__(self, envs: "Environments") -> Mapping[str, Array]:
        """The state of each environment, (n, ...) each; nothing where there is no MuJoCo."""
        if hasattr(envs.instances, "mujoco_state"):
            self._models = self._models or envs.instances.models
            return envs.instances.mujoco_state
        running = (
            [physics_of(env) for env in envs.instances] if isinstance(envs.instances, list) else []
        )
        every = [physics for physics in running if physics]
        if len(every) < envs.num_envs or len({p.model.nq for p in every}) > 1:
            return {}
        self._models = self._models or [physics.model for physics in every]
        return {name: np.stack([getattr(p.data, name) for p in every]) for name in _STATE}

    def motion(self, recording: "Recording", index: int, steps: int) -> Motion | None:
        """What the robot of an environment went through in its first steps; None without MuJoCo."""
        if not recording.arrays:
            return None
        read = recording.arrays.items()
        return Motion(self._models[index], {n: values[: steps + 1, index] for n, values in read})
