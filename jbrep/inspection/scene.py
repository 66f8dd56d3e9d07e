"""The episode in three dimensions: robot, surroundings, trail, decoded Jitterbug."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Task
from jbrep.inspection.recording import SKY, Recording, pieces
from jbrep.inspection.robot import Robot
from jbrep.jitterbug.tasks import MOTOR_QPOS, POSITION, QPOS_SIZE, QUATERNION, jitterbug_task

WORLD = "world"
ROBOT = f"{WORLD}/robot"
SURROUNDINGS = f"{WORLD}/surroundings"
TRAIL = f"{WORLD}/trail"
_TRAIL_RADIUS = 0.008  # in sizes of the robot
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
    radius = _TRAIL_RADIUS * robot.size
    ground = np.column_stack((path[:, :2], np.full(len(path), radius)))
    recording.send_moving(TRAIL, times, rr.LineStrips3D, SKY, radius, strips=pieces(ground))


def as_qpos(task: Task, observation: Array) -> Array:
    """Positions (n, 16) from observations (n, d); the legs, which they lack, are at rest."""
    own = jitterbug_task(task)
    assert own
    parts = own.plain.split(observation)  # a file of features may group them otherwise
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
