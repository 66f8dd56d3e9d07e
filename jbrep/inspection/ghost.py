"""The Jitterbug as decoded from a latent: a ghost, and its distance from the robot."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Task
from jbrep.inspection.recording import ORANGE, SKY, Recording
from jbrep.inspection.robot import Robot, rotate
from jbrep.jitterbug.tasks import MOTOR_QPOS, POSITION, QPOS_SIZE, QUATERNION

GHOST = "world/ghost"
ALIGNED = "world/aligned"
_OPACITY = 170  # of 255
_ALIGNED_COLOUR = (*SKY, _OPACITY)
_RANGE = (1e-3, 1e-1)  # [m] errors at the ends of the colour scale, which is logarithmic
_VIRIDIS = (  # without its dark end, which is invisible here; safe for colour blindness
    *((59, 82, 139), (44, 114, 142), (33, 145, 140), (40, 174, 128)),
    *((94, 201, 98), (173, 220, 48), (253, 231, 37)),
)
_HEADING_LENGTH = 0.06  # [m]
_HEADING_RADIUS = 0.001  # [m]
_TARGET_RADIUS = 0.006  # [m]


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
    """Send the decoded robot at its decoded position, and again at the true one.

    Args:
        recording: to draw in.
        robot: the Jitterbug.
        times: of the states.
        task: one of the Jitterbug's.
        motion: what the robot really went through, n states.
        decoded: observations (n, d) in physical units.
    """
    qpos = as_qpos(task, decoded)
    ghost, true = robot.poses(Motion(robot.model, {"qpos": qpos})), robot.poses(motion)
    apart = np.linalg.norm(ghost.position - true.position, axis=2)[:, robot.bodies]
    colours = shades(apart.ravel()).reshape(*apart.shape, 4)
    robot.draw(recording, GHOST, times, ghost, robot.bodies, colours)
    aligned = np.concatenate((motion.qpos[:, POSITION], qpos[:, QUATERNION.start :]), axis=1)
    turned = robot.poses(Motion(robot.model, {"qpos": aligned}))
    plain = np.array(_ALIGNED_COLOUR, np.uint8)
    robot.draw(recording, ALIGNED, times, turned, robot.bodies, plain)
    names = [f"{robot.names[body]} [mm]" for body in robot.bodies]
    recording.send_series("error/bodies", times, 1e3 * apart, names)
    _send_goal(recording, times, task, decoded, qpos)


def _send_goal(
    recording: Recording,
    times: Sequence[rr.TimeColumn],
    task: Task,
    decoded: Array,
    qpos: Array,
) -> None:
    """Send the decoded target, if the task observes it."""
    parts = task.split(decoded)
    origin, turned = qpos[:, POSITION], qpos[:, QUATERNION]
    if "target" in parts:
        points = rr.Points3D.columns(positions=origin + rotate(turned, parts["target"]))
        recording.send_columns(f"{GHOST}/target", times, points)
        recording.send(
            f"{GHOST}/target",
            rr.Points3D.from_fields(colors=[ORANGE], radii=[_TARGET_RADIUS]),
        )
    if "angle_to_target" in parts:
        face = rotate(turned, np.tile((0.0, -1.0, 0.0), (len(turned), 1)))
        yaw = np.arctan2(face[:, 1], face[:, 0]) + parts["angle_to_target"][:, 0]
        ahead = np.stack((np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)), axis=1)
        arrows = rr.Arrows3D.columns(origins=origin, vectors=_HEADING_LENGTH * ahead)
        recording.send_columns(f"{GHOST}/heading", times, arrows)
        recording.send(
            f"{GHOST}/heading",
            rr.Arrows3D.from_fields(colors=[ORANGE], radii=[_HEADING_RADIUS]),
        )
