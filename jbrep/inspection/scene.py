"""The episode in three dimensions: robot, floor, target, trail and contacts."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.inspection.recording import GREEN, SKY, Recording
from jbrep.inspection.robot import Robot, transform
from jbrep.jitterbug.tasks import Array
from jbrep.rollouts.rollout import Rollout

WORLD = "world"
ROBOT = f"{WORLD}/robot"
TRAIL = f"{WORLD}/trail"
CONTACTS = f"{WORLD}/contacts"
_FLOOR_MARGIN = 0.3  # [m] beyond the path
_FLOOR_THICKNESS = 0.001  # [m]
_FLOOR_COLOUR = (58, 66, 80)
_TRAIL_RADIUS = 0.0006  # [m]
_CONTACT_RADIUS = 0.0012  # [m]
_WEIGHT_LENGTH = 0.05  # [m] of the arrow for a force of the robot's weight


class Contacts(NamedTuple):
    """The contacts with the floor in each of n states."""

    counts: NDArray[np.int64]  # (n,)
    points: Array  # (sum of the counts, 3) in the world [m]
    forces: Array  # (sum of the counts, 3) on the robot, in world axes [N]


def contacts(robot: Robot, rollout: Rollout) -> Contacts:
    """Find the contact points and forces in each state."""
    model = robot.model
    data, force = mujoco.MjData(model), np.zeros(6)
    counts: list[int] = []
    points: list[Array] = []
    forces: list[Array] = []
    drive = np.append(rollout.action[:, 0], rollout.action[-1:, 0])  # the last is held
    for qpos, qvel, control in zip(rollout.qpos, rollout.qvel, drive, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, control
        mujoco.mj_forward(model, data)
        touching = data.contact
        counts.append(data.ncon)
        points.append(touching.pos.copy())
        for i, frame in enumerate(touching.frame.reshape(-1, 3, 3)):
            mujoco.mj_contactForce(model, data, i, force)
            forces.append(force[:3] @ frame)
    return Contacts(np.array(counts), np.concatenate(points), np.reshape(forces, (-1, 3)))


def send_scene(
    recording: Recording, robot: Robot, times: Sequence[rr.TimeColumn], rollout: Rollout
) -> None:
    """Send the robot, floor, target, trail and contacts."""
    recording.send(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    robot.draw(recording, ROBOT, times, rollout.qpos)
    send_floor(recording, rollout.qpos[:, :2])
    target = transform(rollout.target_position[None], rollout.target_quaternion[None])
    recording.send_columns(f"{WORLD}/target", (), target)
    robot.draw_geoms(recording, f"{WORLD}/target", "target")
    _send_trail(recording, times, rollout.qpos[:, :2])
    _send_contacts(recording, times, contacts(robot, rollout), _weight(robot))


def send_floor(recording: Recording, path: Array) -> None:
    """Send a slab that reaches beyond all points (n, 2) of a path."""
    low, high = path.min(axis=0) - _FLOOR_MARGIN, path.max(axis=0) + _FLOOR_MARGIN
    slab = rr.Boxes3D(
        half_sizes=[(*(high - low) / 2, _FLOOR_THICKNESS / 2)],
        centers=[(*(high + low) / 2, -_FLOOR_THICKNESS)],
        colors=[_FLOOR_COLOUR],
        fill_mode=rr.components.FillMode.Solid,
    )
    recording.send(f"{WORLD}/floor", slab)


def _send_trail(recording: Recording, times: Sequence[rr.TimeColumn], path: Array) -> None:
    """Send the path of the robot's origin, (n, 2), on the floor: a line for each step."""
    ground = np.column_stack((path, np.full(len(path), _TRAIL_RADIUS)))
    pieces = np.stack((np.concatenate((ground[:1], ground[:-1])), ground), axis=1)
    recording.send_columns(TRAIL, times, rr.LineStrips3D.columns(strips=pieces))
    style = rr.LineStrips3D.from_fields(colors=[SKY], radii=[_TRAIL_RADIUS])
    recording.send(TRAIL, style)


def _send_contacts(
    recording: Recording, times: Sequence[rr.TimeColumn], touching: Contacts, weight: float
) -> None:
    arrows = touching.forces * (_WEIGHT_LENGTH / weight)
    points = rr.Points3D.columns(positions=touching.points).partition(touching.counts)
    forces = rr.Arrows3D.columns(origins=touching.points, vectors=arrows).partition(touching.counts)
    recording.send_columns(CONTACTS, times, points, forces)
    recording.send(
        CONTACTS,
        rr.Points3D.from_fields(colors=[GREEN], radii=[_CONTACT_RADIUS]),
        rr.Arrows3D.from_fields(colors=[GREEN], radii=[_CONTACT_RADIUS / 2]),
    )


def _weight(robot: Robot) -> float:
    """The robot's weight [N]."""
    return float(robot.model.body("jitterbug").subtreemass[0] * -robot.model.opt.gravity[2])
