"""Scripted policies, one for each task: observations (n, d) to actions (n, 1).

The bug hops toward the bearing that its weight swings back and forth about, whichever way it faces,
and turns when the weight spins in bursts. A policy chooses the bearing or the angle to turn by.
Bearings are in the bug's frame, 0 forward and counter-clockwise; tools/tune_heuristics.py searches
over the constants.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jbrep.coordinates import wrapped
from jbrep.envs.task import Array
from jbrep.jitterbug.tasks import get_task


@dataclass(frozen=True)
class Walk:
    """Constants of the gait that hops toward a bearing; drives are at most 1."""

    pull: float = 0.88  # drive back to the bearing, at a right angle to it
    push: float = 0.47  # drive along the swing, at the bearing
    keep: float = 0.41  # drive along the swing, everywhere
    limit: float = 0.81  # largest drive; more would tip the bug over
    late: float = 0.006  # delay of turning back [s]
    ahead: float = 0.004  # prediction of the bug's own turning [s]
    rise: float = 2.6  # additional drive while the body rises, per m/s
    nod: float = 0.026  # additional drive while it pitches toward the bearing, per rad/s


@dataclass(frozen=True)
class Turn:
    """Constants of the gait that turns on the spot."""

    burst: float = 0.73  # largest drive
    gentle: float = 0.42  # smallest drive of a burst
    hurry: float = 0.8  # additional drive per radian to go
    coast: float = 0.0  # drive while the weight is faster than `fast`
    fast: float = 65.0  # [rad/s]
    near: float = 0.06  # rest when closer than this [rad]
    ahead: float = 0.055  # prediction of the current turn [s]


@dataclass(frozen=True)
class Approach:
    """Constants of slowing down toward a point."""

    gentle: float = 0.65  # share of the drive on arrival
    hurry: float = 3.8  # additional share per metre to go
    there: float = 0.0035  # rest, or turn, when closer than this [m]


WALK = Walk()
TURN = Turn()
APPROACH = Approach()
POSE_APPROACH = Approach(gentle=0.77, hurry=2.4, there=0.0185)
POSE_TURN = Turn(burst=0.60, gentle=0.60, hurry=0.0, coast=0.12, fast=38.0, near=0.21, ahead=0.068)


def walk_toward(state: dict[str, Array], bearing: Array, walk: Walk) -> Array:
    """The drive that hops toward the bearing; this and the bearing are (n, 1)."""
    speed = state["motor_velocity"]
    spin_x, spin_y, spin_z = np.split(state["angular_velocity"], 3, axis=1)
    bearing = bearing - walk.ahead * spin_z
    error = wrapped(state["motor_angle"] - walk.late * speed - bearing)
    rise = walk.rise * state["velocity"][:, 2:]
    nod = walk.nod * (np.cos(bearing) * spin_x + np.sin(bearing) * spin_y)
    along = walk.keep + walk.push * np.cos(error) + rise + nod
    drive = np.tanh(speed / 15) * along - walk.pull * np.sin(error)
    return np.clip(drive, -walk.limit, walk.limit)


def turn_by(state: dict[str, Array], angle: Array, turn: Turn) -> Array:
    """The drive that turns the bug by the angle, (n, 1), in bursts of spinning the weight."""
    angle = angle - turn.ahead * state["angular_velocity"][:, 2:]
    side = np.sign(angle)
    burst = np.minimum(turn.gentle + turn.hurry * np.abs(angle), turn.burst)
    drive = np.where(side * state["motor_velocity"] < turn.fast, burst, turn.coast)
    return np.where(np.abs(angle) < turn.near, 0, side * drive)


def _distance(state: dict[str, Array]) -> Array:
    return np.hypot(state["target"][:, :1], state["target"][:, 1:2])


def approach_target(state: dict[str, Array], walk: Walk, approach: Approach) -> Array:
    """The drive that hops to the target, more gently the nearer it is."""
    x, y, _ = np.split(state["target"], 3, axis=1)
    share = np.minimum(approach.gentle + approach.hurry * _distance(state), 1)
    return share * walk_toward(state, np.arctan2(x, -y), walk)


def move_from_origin(observation: Array, walk: Walk = WALK) -> Array:
    """Hop straight out."""
    state = get_task("move_from_origin").plain.split(observation)
    w, x, y, z = np.split(state["orientation"], 4, axis=1)
    heading = np.arctan2(2 * (x**2 + z**2) - 1, 2 * (w * z - x * y))
    outward = np.arctan2(state["position"][:, 1:2], state["position"][:, :1])
    return walk_toward(state, outward - heading, walk)


def face_direction(observation: Array, turn: Turn = TURN) -> Array:
    """Turn by the angle to the target."""
    state = get_task("face_direction").plain.split(observation)
    return turn_by(state, state["angle_to_target"], turn)


def move_in_direction(observation: Array, walk: Walk = WALK) -> Array:
    """Hop toward where the target's yaw points."""
    state = get_task("move_in_direction").plain.split(observation)
    return walk_toward(state, state["angle_to_target"], walk)


def move_to_position(observation: Array, walk: Walk = WALK, approach: Approach = APPROACH) -> Array:
    """Hop to the target and rest there."""
    state = get_task("move_to_position").plain.split(observation)
    go = approach_target(state, walk, approach)
    return np.where(_distance(state) > approach.there, go, 0)


def move_to_pose(
    observation: Array,
    walk: Walk = WALK,
    approach: Approach = POSE_APPROACH,
    turn: Turn = POSE_TURN,
) -> Array:
    """Hop to the target; there, turn."""
    state = get_task("move_to_pose").plain.split(observation)
    go = approach_target(state, walk, approach)
    face = turn_by(state, state["angle_to_target"], turn)
    return np.where(_distance(state) > approach.there, go, face)


_ALL = move_from_origin, face_direction, move_in_direction, move_to_position, move_to_pose
HEURISTICS: dict[str, Callable[..., Array]] = {policy.__name__: policy for policy in _ALL}
