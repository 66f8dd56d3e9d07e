"""The five Jitterbug tasks: features, starts and rewards, once, over a leading batch axis.

Nothing here steps a simulation: the dm_control domain calls these functions with a batch of one,
the batched simulation with n. Lengths in m, angles in rad, times in s; n is the batch size.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from dm_control.utils import rewards
from numpy.typing import NDArray

from jbrep.errors import InputError

Array = NDArray[np.float64]
_Float = TypeVar("_Float", bound=np.floating[Any])

CONTROL_TIMESTEP = 0.01  # [s]
EPISODE_STEPS = 1000  # control steps
DISCOUNT = 0.99

_MAX_TILT = 0.025  # of the start's turning axis, in x and y
_TARGET_HEIGHT = 0.035  # [m]
_TARGET_RADIUS = (0.05, 0.2)  # [m]
_TURN = (-np.pi, np.pi)  # [rad]

_UPRIGHT_MARGIN = 0.5  # of the cosine of the tilt
_POSITION_MARGIN = 0.05  # [m]
_HEADING_MARGIN = np.pi / 2  # [rad]
_TARGET_SPEED = 0.1  # [m/s]


class Readings(NamedTuple):
    """What a task reads of n simulations: states, and two quantities that MuJoCo derives."""

    qpos: Array  # (n, 16) root position, root quaternion, 8 leg joints, motor
    qvel: Array  # (n, 15) root velocity (world), root angular velocity (body), joints
    rotation: Array  # (n, 9) body to world, row by row
    velocity: Array  # (n, 3) of the body's centre of mass, world frame [m/s]
    target_position: Array  # (n, 3)
    target_quaternion: Array  # (n, 4) a turn about z


class Start(NamedTuple):
    """How an episode begins; everything else is at the model's defaults."""

    quaternion: Array  # (4,) of the root
    target_position: Array  # (3,)
    target_quaternion: Array  # (4,)


def wrap(angle: Array) -> Array:
    """The same angle in [-pi, pi)."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def uprightness(r: Readings) -> Array:
    """Cosine between the bug's z axis and the world's, (n,)."""
    return r.rotation[:, 8]


def motor_angle(r: Readings) -> Array:
    """Where the weight points in the bug's frame, 0 forward, counter-clockwise, (n,)."""
    return wrap(r.qpos[:, 15] + np.pi / 2)


def angle_to_target(r: Readings) -> Array:
    """Target yaw less the yaw of the bug's face (its -Y axis), wrapped, (n,)."""
    heading = np.arctan2(-r.rotation[:, 4], -r.rotation[:, 1])
    target_yaw = 2 * np.arctan2(r.target_quaternion[:, 3].copy(), r.target_quaternion[:, 0].copy())
    return wrap(target_yaw - heading)


def target_in_bug_frame(r: Readings) -> Array:
    """Target position seen from the bug: +X its left, -Y its front, (n, 3)."""
    offset = r.target_position - r.qpos[:, :3]
    return (r.rotation.reshape(-1, 3, 3) * offset[:, :, None]).sum(axis=1)


def velocity_in_target_frame(r: Readings) -> Array:
    """Velocity of the body's centre of mass, +X along the target's yaw, (n, 3)."""
    w, z = r.target_quaternion[:, 0], r.target_quaternion[:, 3]
    cosine, sine = w * w - z * z, 2 * w * z
    x, y = r.velocity[:, 0], r.velocity[:, 1]
    return np.stack((cosine * x + sine * y, cosine * y - sine * x, r.velocity[:, 2]), axis=1)


def distance_to_target(r: Readings) -> Array:
    """Distance from the bug's origin to the target, (n,)."""
    offset = r.target_position - r.qpos[:, :3]
    return np.sqrt((offset * offset).sum(axis=1))


@dataclass(frozen=True)
class Feature:
    """One number of an observation."""

    name: str
    unit: str
    low: float  # nominal range: where the robot usually is, not a bound
    high: float


@dataclass(frozen=True)
class Observable:
    """A named group of features and how it is read: a batch of readings to (n, len(features))."""

    name: str
    features: tuple[Feature, ...]
    read: Callable[[Readings], Array]


def _observable(
    name: str, axes: str, unit: str, highs: tuple[float, ...], read: Callable[[Readings], Array]
) -> Observable:
    names = [f"{name}_{axis}" for axis in axes.split()] or [name]
    features = (Feature(n, unit, -high, high) for n, high in zip(names, highs, strict=True))
    return Observable(name, tuple(features), read)


_POSITION = Observable(
    "position",
    (
        Feature("position_x", "m", -2, 2),
        Feature("position_y", "m", -2, 2),
        Feature("position_z", "m", 0, 0.1),
    ),
    lambda r: r.qpos[:, 0:3],
)
_SHARED = (
    _POSITION,
    _observable("orientation", "w x y z", "1", (1, 1, 1, 1), lambda r: r.qpos[:, 3:7]),
    _observable("velocity", "x y z", "m/s", (1, 1, 1), lambda r: r.qvel[:, 0:3]),
    _observable("angular_velocity", "x y z", "rad/s", (35, 35, 35), lambda r: r.qvel[:, 3:6]),
    _observable("motor_angle", "", "rad", (np.pi,), lambda r: motor_angle(r)[:, None]),
    _observable("motor_velocity", "", "rad/s", (180,), lambda r: r.qvel[:, 14:15]),
)
_ANGLE_TO_TARGET = _observable(
    "angle_to_target", "", "rad", (np.pi,), lambda r: angle_to_target(r)[:, None]
)
_TARGET_VELOCITY = _observable(
    "velocity_in_target_frame", "x y z", "m/s", (1, 1, 1), velocity_in_target_frame
)
_TARGET_POSITION = _observable("target", "x y z", "m", (3, 3, 0.1), target_in_bug_frame)


def upright_term(r: Readings) -> Array:
    """1 standing, 0.1 at a tilt of 60 degrees."""
    return rewards.tolerance(uprightness(r), bounds=(1, 1), margin=_UPRIGHT_MARGIN)


def position_term(r: Readings) -> Array:
    """1 at the target, 0.1 at 5 cm from it."""
    return rewards.tolerance(distance_to_target(r), margin=_POSITION_MARGIN)


def away_term(r: Readings) -> Array:
    """0 at the target, 0.9 at 5 cm from it."""
    return 1 - position_term(r)


def heading_term(r: Readings) -> Array:
    """1 facing along the target's yaw, 0 from 90 degrees on."""
    return rewards.tolerance(
        angle_to_target(r), margin=_HEADING_MARGIN, value_at_margin=0, sigmoid="cosine"
    )


def velocity_term(r: Readings) -> Array:
    """1 from 0.1 m/s along the target's yaw on, falling linearly to 0 at rest."""
    return rewards.tolerance(
        velocity_in_target_frame(r)[:, 0],
        bounds=(_TARGET_SPEED, np.inf),
        margin=_TARGET_SPEED,
        value_at_margin=0,
        sigmoid="linear",
    )


@dataclass(frozen=True)
class Task:
    """What is observed, how an episode starts and what is rewarded.

    The reward is the product of the terms, each in [0, 1].
    """

    name: str
    level: str  # dm_control's tag: "easy" or "hard"
    observables: tuple[Observable, ...]
    terms: tuple[Callable[[Readings], Array], ...]
    target_radius: tuple[float, float] = (0, 0)  # [m]
    target_yaw: tuple[float, float] = (0, 0)  # [rad]

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """All features in the order of the flat observation."""
        return tuple(f for observable in self.observables for f in observable.features)

    @property
    def size(self) -> int:
        """Length d of the flat observation."""
        return len(self.features)

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Their names, in that order."""
        return tuple(f.name for f in self.features)

    @cached_property
    def _centre(self) -> Array:
        return np.array([(f.high + f.low) / 2 for f in self.features])

    @cached_property
    def _half_width(self) -> Array:
        return np.array([(f.high - f.low) / 2 for f in self.features])

    @cached_property
    def _start_ranges(self) -> Array:
        tilt = (-_MAX_TILT, _MAX_TILT)
        return np.array([_TURN, tilt, tilt, self.target_radius, _TURN, self.target_yaw]).T

    def observe(self, readings: Readings) -> Array:
        """The flat observation in physical units, (n, d)."""
        return np.concatenate([o.read(readings) for o in self.observables], axis=1)

    def reward(self, readings: Readings) -> Array:
        """The reward in [0, 1], (n,)."""
        reward = upright_term(readings)
        for term in self.terms:
            reward = reward * term(readings)
        return reward

    def scale(self, observation: Array) -> Array:
        """Physical units to about [-1, 1], by the nominal ranges; (n, d) to (n, d)."""
        return (observation - self._centre) / self._half_width

    def unscale(self, scaled: Array) -> Array:
        """The inverse of `scale`."""
        return scaled * self._half_width + self._centre

    def split(self, observation: NDArray[_Float]) -> dict[str, NDArray[_Float]]:
        """A flat observation (..., d) as a dictionary by observable; the parts are views."""
        ends = np.cumsum([len(o.features) for o in self.observables])[:-1]
        parts = np.split(observation, ends, axis=-1)
        return {o.name: part for o, part in zip(self.observables, parts, strict=True)}

    def start(self, random: np.random.Generator | np.random.RandomState) -> Start:
        """Draw how an episode begins.

        Every task takes the same six draws, so one seed gives one motion whatever the task.
        """
        low, high = self._start_ranges
        turn, tilt_x, tilt_y, radius, bearing, yaw = random.uniform(low, high)
        axis = np.array([tilt_x, tilt_y, 1.0]) / np.sqrt(tilt_x**2 + tilt_y**2 + 1)
        return Start(
            np.append(np.cos(turn / 2), np.sin(turn / 2) * axis),
            np.array([radius * np.cos(bearing), radius * np.sin(bearing), _TARGET_HEIGHT]),
            np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]),
        )


TASKS = {
    task.name: task
    for task in (
        Task("move_from_origin", "easy", _SHARED, (away_term,)),
        Task(
            "face_direction",
            "easy",
            (*_SHARED, _ANGLE_TO_TARGET),
            (heading_term,),
            target_yaw=_TURN,
        ),
        Task(
            "move_in_direction",
            "easy",
            (*_SHARED, _ANGLE_TO_TARGET, _TARGET_VELOCITY),
            (velocity_term,),
            target_yaw=_TURN,
        ),
        Task(
            "move_to_position",
            "hard",
            (*_SHARED, _TARGET_POSITION),
            (position_term,),
            target_radius=_TARGET_RADIUS,
        ),
        Task(
            "move_to_pose",
            "hard",
            (*_SHARED, _TARGET_POSITION, _ANGLE_TO_TARGET),
            (position_term, heading_term),
            target_radius=_TARGET_RADIUS,
            target_yaw=_TURN,
        ),
    )
}


def get_task(name: str) -> Task:
    """The task of that name.

    Raises:
        InputError: there is none; the message lists the tasks.
    """
    if name not in TASKS:
        raise InputError(f"unknown task {name!r}: choose one of {', '.join(TASKS)}")
    return TASKS[name]
