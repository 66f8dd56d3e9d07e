"""The episode in three dimensions: robot, surroundings, trail, contacts, decoded Jitterbug."""

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Task
from jbrep.inspection.recording import GREEN, ORANGE, SKY, Recording, pieces
from jbrep.inspection.robot import XYZW, Robot, rotate
from jbrep.jitterbug.tasks import MOTOR_QPOS, POSITION, QPOS_SIZE, QUATERNION

WORLD = "world"
ROBOT = f"{WORLD}/robot"
SURROUNDINGS = f"{WORLD}/surroundings"
FLOOR = f"{WORLD}/floor"
TRAIL = f"{WORLD}/trail"
CONTACTS = f"{WORLD}/contacts"
_FLOOR_COLOUR = (58, 66, 80)
# in sizes of the robot
_FLOOR_MARGIN = 4.0  # beyond the path
_FLOOR_THICKNESS = 0.013
_TRAIL_RADIUS = 0.008
_CONTACT_RADIUS = 0.016
_WEIGHT_LENGTH = 0.65  # of the arrow for a force of the robot's weight
GHOST = "world/ghost"
_OPACITY = 170  # of 255
_RANGE = (1e-3, 1e-1)  # [m] errors at the ends of the colour scale, which is logarithmic
_VIRIDIS = (  # without its dark end, which is invisible here; safe for colour blindness
    *((59, 82, 139), (44, 114, 142), (33, 145, 140), (40, 174, 128)),
    *((94, 201, 98), (173, 220, 48), (253, 231, 37)),
)
_HEADING_LENGTH = 0.06  # [m]
_HEADING_RADIUS = 0.001  # [m]
_TARGET_RADIUS = 0.006  # [m]


def contacts(robot: Robot, motion: Motion) -> tuple[NDArray[np.int64], Array, Array]:
    """The number of contacts in each of n states, and their points and forces one after the other.

    Returns:
        Numbers (n,); points (sum of these, 3) in the world [m]; forces on the robot, of two parts
        of the robot those on the second, (sum of these, 3) in world axes [N].
    """
    model, is_robot = robot.model, np.isin(np.arange(robot.model.nbody), robot.bodies)
    data, force = mujoco.MjData(model), np.zeros(6)
    counts: list[int] = []
    points: list[Array] = []
    forces: list[Array] = []
    for state in range(len(motion)):
        motion.put(data, state)
        mujoco.mj_forward(model, data)
        touching = data.contact
        counts.append(data.ncon)
        points.append(touching.pos.copy())
        for i, frame in enumerate(touching.frame.reshape(-1, 3, 3)):
            mujoco.mj_contactForce(model, data, i, force)
            second = touching.geom[i, 1]  # which the force acts on; below 0 for a flexible body
            on_robot = second < 0 or is_robot[model.geom_bodyid[second]]
            forces.append(force[:3] @ frame * (1 if on_robot else -1))
    return np.array(counts), np.concatenate(points), np.reshape(forces, (-1, 3))


def send_scene(
    recording: Recording, robot: Robot, times: Sequence[rr.TimeColumn], motion: Motion
) -> None:
    """Send the robot, its surroundings, trail and contacts."""
    poses = robot.poses(motion)
    path = poses.position[:, robot.root]
    recording.send(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    robot.draw(recording, ROBOT, times, poses, robot.bodies)
    robot.draw(recording, SURROUNDINGS, times, poses, robot.others)
    send_floor(recording, robot, path)
    radius = _TRAIL_RADIUS * robot.size
    ground = np.column_stack((path[:, :2], np.full(len(path), radius)))
    recording.send_moving(TRAIL, times, rr.LineStrips3D, SKY, radius, strips=pieces(ground))
    _send_contacts(recording, times, motion, robot)


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


def _send_contacts(
    recording: Recording, times: Sequence[rr.TimeColumn], motion: Motion, robot: Robot
) -> None:
    counts, places, forces = contacts(robot, motion)
    unit = robot.weight or float(np.linalg.norm(forces, axis=1).max(initial=0)) or 1.0
    arrows = forces * (_WEIGHT_LENGTH * robot.size / unit)
    points = rr.Points3D.columns(positions=places).partition(counts)
    along = rr.Arrows3D.columns(origins=places, vectors=arrows).partition(counts)
    recording.send_columns(CONTACTS, times, points, along)
    radius = _CONTACT_RADIUS * robot.size
    recording.send(
        CONTACTS,
        rr.Points3D.from_fields(colors=[GREEN], radii=[radius]),
        rr.Arrows3D.from_fields(colors=[GREEN], radii=[radius / 2]),
    )


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
    qpos = as_qpos(task, decoded)
    ghost, true = robot.poses(Motion(robot.model, {"qpos": qpos})), robot.poses(motion)
    apart = np.linalg.norm(ghost.position - true.position, axis=2)[:, robot.bodies]
    colours = shades(apart.ravel()).reshape(*apart.shape, 4)
    robot.draw(recording, GHOST, times, ghost, robot.bodies, colours)
    names = [f"{robot.names[body]} [mm]" for body in robot.bodies]
    recording.send_series("error/bodies", times, 1e3 * apart, names)
    _send_goal(recording, times, task, decoded, qpos)


def _send_goal(
    recording: Recording, times: Sequence[rr.TimeColumn], task: Task, decoded: Array, qpos: Array
) -> None:
    parts = task.split(decoded)
    origin, turned = qpos[:, POSITION], qpos[:, QUATERNION]
    if "target" in parts:
        points = origin + rotate(turned, parts["target"])
        look = rr.Points3D, ORANGE, _TARGET_RADIUS
        recording.send_moving(f"{GHOST}/target", times, *look, positions=points)
    if "angle_to_target" in parts:
        face = rotate(turned, np.tile((0.0, -1.0, 0.0), (len(turned), 1)))
        yaw = np.arctan2(face[:, 1], face[:, 0]) + parts["angle_to_target"][:, 0]
        ahead = np.stack((np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)), axis=1)
        path, vectors = f"{GHOST}/heading", _HEADING_LENGTH * ahead
        arrow = rr.Arrows3D, ORANGE, _HEADING_RADIUS
        recording.send_moving(path, times, *arrow, origins=origin, vectors=vectors)
