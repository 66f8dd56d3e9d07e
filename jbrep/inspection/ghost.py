"""An encoder's reconstruction of an episode: the decoded robot, a ghost, and its errors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.encoders import Encoder
from jbrep.inspection.recording import ORANGE, SKY, Recording
from jbrep.inspection.robot import Robot, rotate
from jbrep.jitterbug.tasks import Array, Task
from jbrep.rollouts.rollout import Rollout

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


class Ghost(NamedTuple):
    """An episode of n states, encoded to l units and decoded again."""

    latent: NDArray[np.float32]  # (n, l)
    observation: Array  # decoded, (n, d) in physical units
    qpos: Array  # (n, 16) of the decoded robot

    @classmethod
    def of(cls, encoder: Encoder, task: Task, latent: NDArray[np.float32]) -> "Ghost":
        """The decoded states of latents (n, l)."""
        decoded = encoder.decode(latent).astype(np.float64)
        return cls(latent, decoded, as_qpos(task, decoded))


def as_qpos(task: Task, observation: Array) -> Array:
    """Positions (n, 16) from observations (n, d); the legs, which they lack, are at rest."""
    parts = task.split(observation)
    given = parts["orientation"].any(axis=1, keepdims=True)
    turned = np.where(given, parts["orientation"], (1.0, 0.0, 0.0, 0.0))
    qpos = np.zeros((len(observation), 16))
    qpos[:, :3] = parts["position"]
    qpos[:, 3:7] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    qpos[:, 15] = parts["motor_angle"][:, 0] - np.pi / 2
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
    rollout: Rollout,
    ghost: Ghost,
) -> None:
    """Send the decoded robot at its decoded position, and again at the true one."""
    there = robot.origins(rollout.qpos)
    apart = {
        name: np.linalg.norm(origin - there[name], axis=1)
        for name, origin in robot.origins(ghost.qpos).items()
    }
    colours = {name: shades(errors) for name, errors in apart.items()}
    robot.draw(recording, GHOST, times, ghost.qpos, colours, legs(robot))
    aligned = np.concatenate((rollout.qpos[:, :3], ghost.qpos[:, 3:]), axis=1)
    plain = dict.fromkeys(robot.bodies, np.array(_ALIGNED_COLOUR, np.uint8))
    robot.draw(recording, ALIGNED, times, aligned, plain, legs(robot))
    millimetres = 1e3 * np.stack(list(apart.values()), axis=1)
    recording.send_series("error/bodies", times, millimetres, [f"{name} [mm]" for name in apart])
    _send_goal(recording, times, rollout.task, ghost)


def legs(robot: Robot) -> list[str]:
    """The bodies that no task observes."""
    return [name for name in robot.bodies if name.startswith("leg")]


def _send_goal(
    recording: Recording, times: Sequence[rr.TimeColumn], task: Task, ghost: Ghost
) -> None:
    """Send the decoded target, if the task observes it."""
    parts = task.split(ghost.observation)
    origin, turned = ghost.qpos[:, :3], ghost.qpos[:, 3:7]
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
