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
_WEIGHT_LENGTH = 0.05  # [m] of the arrow of a force as large as the robot's weight


class Contacts(NamedTuple):
    """What carries the robot in each state."""

    counts: NDArray[np.int64]  # (n,)
    points: Array  # (sum of the counts, 3) in the world [m]
    forces: Array  # (sum of the counts, 3) on the robot, in the world [N]


def contacts(robot: Robot, rollout: Rollout) -> Contacts:
    """Where the floor touches the robot in each state, and how hard."""
    model = robot.model
    data, force = mujoco.MjData(model), np.zeros(6)
    counts: list[int] = []
    points: list[Array] = []
    forces: list[Array] = []
    drive = np.append(rollout.action[:, 0], rollout.action[-1:, 0])  # the last one holds on
    for qpos, qvel, control in zip(rollout.qpos, rollout.qvel, drive, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, control
        mujoco.mj_forward(model, data)
        found = data.contact
        counts.append(data.ncon)
        points.append(found.pos.copy())
        for i, frame in enumerate(found.frame.reshape(-1, 3, 3)):
            mujoco.mj_contactForce(model, data, i, force)
            forces.append(force[:3] @ frame)
    return Contacts(np.array(counts), np.concatenate(points), np.reshape(forces, (-1, 3)))


def send_scene(
    recording: Recording, robot: Robot, times: Sequence[rr.TimeColumn], rollout: Rollout
) -> None:
    """The robot and what is around it."""
    recording.send(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    robot.draw(recording, ROBOT, times, rollout.qpos)
    send_floor(recording, rollout.qpos[:, :2])
    target = transform(rollout.target_position[None], rollout.target_quaternion[None])
    recording.send_columns(f"{WORLD}/target", (), target)
    robot.draw_geoms(recording, f"{WORLD}/target", "target")
    _send_trail(recording, times, rollout.qpos[:, :2])
    _send_contacts(recording, times, contacts(robot, rollout), _weight(robot))


def send_floor(recording: Recording, path: Array) -> None:
    """A slab below all places (n, 2) that something stands at."""
    low, high = path.min(axis=0) - _FLOOR_MARGIN, path.max(axis=0) + _FLOOR_MARGIN
    slab = rr.Boxes3D(
        half_sizes=[(*(high - low) / 2, _FLOOR_THICKNESS / 2)],
        centers=[(*(high + low) / 2, -_FLOOR_THICKNESS)],
        colors=[_FLOOR_COLOUR],
        fill_mode=rr.components.FillMode.Solid,
    )
    recording.send(f"{WORLD}/floor", slab)


def _send_trail(recording: Recording, times: Sequence[rr.TimeColumn], path: Array) -> None:
    """The way below the root's origin, (n, 2), a piece for each step."""
    ground = np.column_stack((path, np.full(len(path), _TRAIL_RADIUS)))
    pieces = np.stack((np.concatenate((ground[:1], ground[:-1])), ground), axis=1)
    recording.send_columns(TRAIL, times, rr.LineStrips3D.columns(strips=pieces))
    style = rr.LineStrips3D.from_fields(colors=[SKY], radii=[_TRAIL_RADIUS])
    recording.send(TRAIL, style)


def _send_contacts(
    recording: Recording, times: Sequence[rr.TimeColumn], found: Contacts, weight: float
) -> None:
    arrows = found.forces * (_WEIGHT_LENGTH / weight)
    points = rr.Points3D.columns(positions=found.points).partition(found.counts)
    forces = rr.Arrows3D.columns(origins=found.points, vectors=arrows).partition(found.counts)
    recording.send_columns(CONTACTS, times, points, forces)
    recording.send(
        CONTACTS,
        rr.Points3D.from_fields(colors=[GREEN], radii=[_CONTACT_RADIUS]),
        rr.Arrows3D.from_fields(colors=[GREEN], radii=[_CONTACT_RADIUS / 2]),
    )


def _weight(robot: Robot) -> float:
    """Of the robot [N]."""
    return float(robot.model.body("jitterbug").subtreemass[0] * -robot.model.opt.gravity[2])
