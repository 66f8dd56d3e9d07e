"""The episode in three dimensions: robot, surroundings, trail, decoded Jitterbug."""

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Task
from jbrep.inspection.recording import SKY, Recording, pieces
from jbrep.inspection.robot import XYZW, Robot
from jbrep.jitterbug.tasks import MOTOR_QPOS, POSITION, QPOS_SIZE, QUATERNION

WORLD = "world"
ROBOT = f"{WORLD}/robot"
SURROUNDINGS = f"{WORLD}/surroundings"
FLOOR = f"{WORLD}/floor"
TRAIL = f"{WORLD}/trail"
_FLOOR_COLOUR = (58, 66, 80)
# in sizes of the robot
_FLOOR_MARGIN = 4.0  # beyond the path
_FLOOR_THICKNESS = 0.013
_TRAIL_RADIUS = 0.008
GHOST = "world/ghost"
_OPACITY = 170  # of 255
_RANGE = (1e-3, 1e-1)  # [m] errors at the ends of the colour scale, which is logarithmic
_VIRIDIS = (  # without its dark end, which is invisible here; safe for colour blindness
    *((59, 82, 139), (44, 114, 142), (33, 145, 140), (40, 174, 128)),
    *((94, 201, 98), (173, 220, 48), (253, 231, 37)),
)


def send_scene(
    recording: Recording, robot: Robot, times: Sequence[rr.TimeColumn], motion: Motion
) -> None:
    """Send the robot, its surroundings and its trail."""
    poses = robot.poses(motion)
    path = poses.position[:, robot.root]
    recording.send(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    robot.draw(recording, ROBOT, times, poses, robot.bodies)
    robot.draw(recording, SURROUNDINGS, times, poses, robot.others)
    send_floor(recording, robot, path)
    radius = _TRAIL_RADIUS * robot.size
    ground = np.column_stack((path[:, :2], np.full(len(path), radius)))
    recording.send_moving(TRAIL, times, rr.LineStrips3D, SKY, radius, strips=pieces(ground))


def send_floor(recording: Recording, robot: Robot, path: Array) -> None:
    """Send the model's planes as slabs that reach beyond a path (n, 3), or as far as they do."""
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_kinematics(model, data)
    margin, thick = _FLOOR_MARGIN * robot.size, _FLOOR_THICKNESS * robot.size
    for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
        turned = data.geom_xmat[plane].reshape(3, 3)
        along = (path - data.geom_xpos[plane]) @ turned  # in the plane's frame
        ends = np.where(model.geom_size[plane, :2] > 0, model.geom_size[plane, :2], np.inf)
        low = np.clip(along.min(axis=0)[:2] - margin, -ends, ends)
        high = np.clip(along.max(axis=0)[:2] + margin, -ends, ends)
        centre = np.array([*(low + high) / 2, -thick])
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[plane])
        slab = rr.Boxes3D(
            half_sizes=[(*(high - low) / 2, thick / 2)],
            centers=[data.geom_xpos[plane] + turned @ centre],
            quaternions=[quaternion[XYZW]],
            colors=[_FLOOR_COLOUR],
            fill_mode=rr.components.FillMode.Solid,
        )
        name = model.geom(plane).name or f"plane_{plane}"
        recording.send(f"{FLOOR}/{rr.escape_entity_path_part(name)}", slab)


def as_qpos(task: Task, observation: Array) -> Array:
    """Positions (n, 16) from observations (n, d); the legs, which they lack, are at rest."""
    parts = task.split(observation)
    given = parts["orientation"].any(axis=1, keepdims=True)
    turned = np.where(given, parts["orientation"], (1.0, 0.0, 0.0, 0.0))
    qpos = np.zeros((len(observation), QPOS_SIZE))
    qpos[:, POSITION] = parts["position"]
    qpos[:, QUATERNION] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    qpos[:, MOTOR_QPOS] = parts["motor_angle"][:, 0] - np.pi / 2
    return qpos


def shades(errors: Array) -> NDArray[np.uint8]:
    """Translucent colours (n, 4) for distances (n,) [m]."""
    low, high = np.log(_RANGE)
    place = (np.log(np.clip(errors, *_RANGE)) - low) / (high - low)
    knots = np.linspace(0, 1, len(_VIRIDIS))
    channels = [np.interp(place, knots, channel) for channel in zip(*_VIRIDIS, strict=True)]
    return np.stack([*channels, np.full(len(place), _OPACITY)], axis=1).astype(np.uint8)


def send_ghost(
    recording: Recording,
    robot: Robot,
    times: Sequence[rr.TimeColumn],
    task: Task,
    motion: Motion,
    decoded: Array,
) -> None:
    """Send the robot of decoded observations (n, d) in physical units.

    Its colours show how far each body is from its true place in that motion of n states.
    """
    decoded_motion = Motion(robot.model, {"qpos": as_qpos(task, decoded)})
    ghost, true = robot.poses(decoded_motion), robot.poses(motion)
    apart = np.linalg.norm(ghost.position - true.position, axis=2)[:, robot.bodies]
    colours = shades(apart.ravel()).reshape(*apart.shape, 4)
    robot.draw(recording, GHOST, times, ghost, robot.bodies, colours)
    names = [f"{robot.names[body]} [mm]" for body in robot.bodies]
    recording.send_series("error/bodies", times, 1e3 * apart, names)
