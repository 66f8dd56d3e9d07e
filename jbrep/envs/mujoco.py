"""What MuJoCo's model knows of an environment: the kinds of its features, and how to move it.

Nothing is guessed: a feature is what it equals in all states of some episodes that were played.
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from jbrep.envs.make import random_play
from jbrep.envs.task import SPATIAL, Feature, Frame, Kind

Array = NDArray[np.float64]

_EPISODES, _STEPS = 3, 40  # that are played to see which feature is which quantity
_SAME = 1e-6  # relative difference, of observations in float32
_TURN = 2 * np.pi + 1e-3  # [rad], as models round it


class Physics(NamedTuple):
    """An environment's model and state."""

    model: mujoco.MjModel
    data: mujoco.MjData


class _Quantity(NamedTuple):
    """A number of the state, and what it is."""

    kind: Kind
    frame: Frame
    unit: str
    whole: str  # the vector, point or quaternion that it belongs to; empty if none
    axis: int  # its place in that


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


def with_kinds(env: gymnasium.Env[Any, Any], features: Sequence[Feature]) -> tuple[Feature, ...]:
    """The features with the kinds that follow from the model; those that don't stay scalars.

    Args:
        env: is reset and played for some steps.
        features: of its flat observation.
    """
    physics = physics_of(env)
    if physics is None:
        return tuple(features)
    quantities = dict(_quantities(physics.model))
    observations, states = _played(env)
    found = [_match(column, states, quantities) for column in observations.T]
    return tuple(_described(features, found))


def _quantities(model: mujoco.MjModel) -> Iterator[tuple[int, _Quantity]]:
    """Numbers of the state, qpos and then qvel, that aren't scalars, by their places."""
    robot = _robot_joint(model)
    for joint in range(model.njnt):
        name, place = f"joint{joint}", int(model.jnt_qposadr[joint])
        speed = model.nq + int(model.jnt_dofadr[joint])
        if joint == robot:
            yield from _row(place, "point", "world", "m", f"{name}.position", 3)
            yield from _row(place + 3, "quaternion", "", "1", f"{name}.attitude", 4)
            yield from _row(speed, "vector", "world", "m/s", f"{name}.velocity", 3)
            yield from _row(speed + 3, "vector", "body", "rad/s", f"{name}.angular_velocity", 3)
        elif _is_angle(model, joint):
            yield place, _Quantity("angle", "", "rad", "", 0)
    if robot is None and (root := _planar_root(model)):
        x, y, turn = root
        for axis, joint in enumerate((x, y)):
            yield (
                int(model.jnt_qposadr[joint]),
                _Quantity("point", "world", "m", "root.position", axis),
            )
            yield (
                model.nq + int(model.jnt_dofadr[joint]),
                _Quantity("vector", "world", "m/s", "root.velocity", axis),
            )
        yield int(model.jnt_qposadr[turn]), _Quantity("angle", "world", "rad", "", 0)


def _free_joints(model: mujoco.MjModel) -> list[int]:
    """The joints of free bodies."""
    free: list[int] = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).tolist()
    return free


def _robot_joint(model: mujoco.MjModel) -> int | None:
    """The joint by which the robot is free, if it is: it is the heaviest tree."""
    root = root_of(model)
    return next((each for each in _free_joints(model) if model.jnt_bodyid[each] == root), None)


def _is_angle(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is a hinge on which a turn more is the same place."""
    several = model.jnt_limited[joint] and np.ptp(model.jnt_range[joint]) > _TURN
    return model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and not several


def _row(
    place: int, kind: Kind, frame: Frame, unit: str, whole: str, count: int
) -> Iterator[tuple[int, _Quantity]]:
    for axis in range(count):
        yield place + axis, _Quantity(kind, frame, unit, whole, axis)


def _planar_root(model: mujoco.MjModel) -> tuple[int, int, int] | None:
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


def _played(env: gymnasium.Env[Any, Any]) -> tuple[Array, Array]:
    """Observations (n, d) and states (n, nq + nv) of some episodes under random actions."""
    observations, states = [], []
    for episode in range(_EPISODES):
        for step in islice(random_play(env, episode, _STEPS), 1, None):
            observations.append(step.observation)
            data = physics_of(env).data  # type: ignore[union-attr] # it may be another after a reset
            states.append(np.concatenate((data.qpos, data.qvel)))
    return np.array(observations, np.float64), np.array(states)


def _match(column: Array, states: Array, quantities: dict[int, _Quantity]) -> _Quantity | None:
    """What a feature is, if it equals one number of the state and no other."""
    scale = np.abs(column).max()
    if np.ptp(column) <= _SAME * scale:
        return None  # a constant could be anything
    off = np.abs(states - column[:, None]).max(axis=0)
    equal = np.flatnonzero(off <= _SAME * scale)
    return quantities.get(int(equal[0])) if len(equal) == 1 else None


def _described(features: Sequence[Feature], found: Sequence[_Quantity | None]) -> Iterator[Feature]:
    """Features as what they were found to be, each whole vector a group of its own."""
    parts: dict[str, int] = {}  # of each group, by its name
    before, i = None, 0
    while i < len(features):
        count = _whole(found[i:])
        feature, quantity = features[i], found[i]
        key = feature.group if count == 1 else f"{feature.group}.{quantity.whole}"  # type: ignore[union-attr]
        if key != before:
            parts[key] = parts.get(key, 0) + 1
        group = key if parts[key] == 1 else f"{key}.{parts[key]}"
        for each in features[i : i + count]:
            yield _as(each, quantity, group, count)
        before, i = key, i + count


def _whole(found: Sequence[_Quantity | None]) -> int:
    """How many features from the first one on are one vector, point or quaternion; 1 if none."""
    first = found[0]
    if first is None or not first.whole or first.axis:
        return 1
    row = [
        each is not None and each.whole == first.whole and each.axis == axis
        for axis, each in enumerate(found[:4])
    ]
    count = row.index(False) if False in row else len(row)
    return count if count in SPATIAL[first.kind] else 1


def _as(feature: Feature, quantity: _Quantity | None, group: str, count: int) -> Feature:
    if quantity is None or (quantity.whole and count == 1):
        return feature.replace(group=group)
    return feature.replace(
        group=group,
        kind=quantity.kind,
        frame=quantity.frame,
        unit=feature.unit or quantity.unit,
        bounded=feature.bounded and quantity.kind != "angle",
    )


def quarter_turn(env: gymnasium.Env[Any, Any], shift: tuple[float, float]) -> bool:
    """Turn a robot by a quarter about the world's vertical axis, then shift it [m].

    An environment whose targets move with the robot has a method of that name. A quarter, since
    MuJoCo's pyramidal friction cones are the same along both axes only.

    Returns:
        Whether it could be done: only where one body is free, or one moves in the plane.
    """
    if own := getattr(env.unwrapped, "quarter_turn", None):
        own(shift)
        return True
    physics = physics_of(env)
    if physics is None:
        return False
    model, data = physics
    robot = _robot_joint(model)
    if any(each != robot for each in _free_joints(model)):
        return False  # whether the others belong to the robot isn't known
    if robot is not None:
        place, speed = int(model.jnt_qposadr[robot]), int(model.jnt_dofadr[robot])
        quaternion = data.qpos[place + 3 : place + 7]
        quaternion[:] = turned_quaternion(quaternion)
        places, speeds = [place, place + 1], [speed, speed + 1]
    elif root := _planar_root(model):
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
