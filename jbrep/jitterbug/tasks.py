"""The five Jitterbug tasks: features, starts and rewards, over a leading batch axis.

Nothing here steps a simulation: the dm_control domain calls these functions with a batch of one,
the batched simulation with n. Lengths in m, angles in rad, times in s; n is the batch size.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jbrep.coordinates import wrapped
from jbrep.envs.task import SHORT_NAMES, Array, Feature, Frame, Kind, Task
from jbrep.errors import choose

CONTROL_TIMESTEP = 0.01  # [s]
EPISODE_STEPS = 1000  # control steps
SOLVED_REWARD = 0.9  # mean of an episode: the paper calls a task solved from there
START_DRAWS = 6  # random numbers that an episode's start takes

# MuJoCo's qpos: root position and quaternion, 8 leg joints, motor; qvel likewise
QPOS_SIZE, QVEL_SIZE = 16, 15
POSITION, QUATERNION = slice(0, 3), slice(3, 7)  # of the root, in qpos
VELOCITY, SPIN = slice(0, 3), slice(3, 6)  # linear and angular, of the root, in qvel
MOTOR_QPOS, MOTOR_QVEL = QPOS_SIZE - 1, QVEL_SIZE - 1

_MAX_TILT = 0.025  # of the axis that the start is turned about, in x and y
_TARGET_HEIGHT = 0.035  # [m]
_TARGET_RADIUS = (0.05, 0.2)  # [m]
_TURN = (-np.pi, np.pi)  # [rad]

_UPRIGHT_MARGIN = 0.5  # in the cosine of the tilt
_POSITION_MARGIN = 0.05  # [m]
_VALUE_AT_MARGIN = 0.1
_TARGET_SPEED = 0.1  # [m/s]


def yaw_direction(quaternion: Array) -> Array:
    """The x and y of the x axis after a rotation about z, (n, 4) to (n, 2)."""
    w, z = quaternion[:, 0], quaternion[:, 3]
    return np.stack((w * w - z * z, 2 * w * z), axis=1)


@dataclass(frozen=True)
class Readings:
    """What the tasks read of n simulations: their states, and quantities derived from them.

    The arrays may be views of a running simulation; make new readings after each step.
    """

    qpos: Array  # (n, 16)
    qvel: Array  # (n, 15); the root's velocity in the world, its angular velocity in the body
    rotation: Array  # (n, 9) body to world, row by row
    velocity: Array  # (n, 3) of the body's centre of mass, world frame [m/s]
    target_position: Array  # (n, 3)
    target_axis: Array  # (n, 2) its x axis in the world's x and y

    @property
    def uprightness(self) -> Array:
        """Cosine of the angle between the bug's z axis and the world's, (n,)."""
        return self.rotation[:, 8]

    @property
    def motor_angle(self) -> Array:
        """Where the weight points in the bug's frame, 0 forward, counter-clockwise, (n,)."""
        return wrapped(self.qpos[:, MOTOR_QPOS] + np.pi / 2)

    @cached_property
    def angle_to_target(self) -> Array:
        """Yaw of the target minus yaw of the bug's face (its -y axis), wrapped, (n,)."""
        x, y = -self.rotation[:, 1], -self.rotation[:, 4]  # where the face looks
        target_x, target_y = self.target_axis.T
        return np.arctan2(x * target_y - y * target_x, x * target_x + y * target_y)

    @property
    def target_in_bug_frame(self) -> Array:
        """Target position in the bug's frame: +x is its left, -y its front, (n, 3)."""
        return (self.rotation.reshape(-1, 3, 3) * self._offset[:, :, None]).sum(axis=1)

    @cached_property
    def velocity_in_target_frame(self) -> Array:
        """Velocity of the body's centre of mass, x along the target's yaw, (n, 3)."""
        cosine, sine = self.target_axis.T
        x, y = self.velocity[:, 0], self.velocity[:, 1]
        turned = self.velocity.copy()
        turned[:, 0] = cosine * x + sine * y
        turned[:, 1] = cosine * y - sine * x
        return turned

    @property
    def distance_to_target(self) -> Array:
        """Distance from the bug's origin to the target, (n,)."""
        x, y, z = self._offset.T
        return np.sqrt(x * x + y * y + z * z)

    @cached_property
    def _offset(self) -> Array:
        return self.target_position - self.qpos[:, POSITION]


class Start(NamedTuple):
    """How an episode begins; everything else is at the model's defaults."""

    quaternion: Array  # (4,) of the root
    target_position: Array  # (3,)
    target_quaternion: Array  # (4,)


@dataclass(frozen=True)
class Observable:
    """A named group of features; `read` maps n readings to (n, len(features))."""

    name: str
    features: tuple[Feature, ...]
    read: Callable[[Readings], Array]


def _observable(
    name: str,
    axes: str,
    unit: str,
    highs: tuple[float, ...],
    read: Callable[[Readings], Array],
    kind: Kind = "scalar",
    frame: Frame = "",
) -> Observable:
    names = [f"{name}_{axis}" for axis in axes.split()] or [name]
    bounded = unit in ("rad", "1")  # wrapped angles and unit quaternions
    features = (
        Feature(each, unit, -float(high), float(high), bounded, name, kind, frame)
        for each, high in zip(names, highs, strict=True)
    )
    return Observable(name, tuple(features), read)


def _position(kind: Kind) -> Observable:
    """Where the bug is: a point, or an offset from the origin if that counts in its task."""
    ranges = {"position_x": (-2.0, 2.0), "position_y": (-2.0, 2.0), "position_z": (0.0, 0.1)}
    features = (
        Feature(name, "m", low, high, False, "position", kind, "world")
        for name, (low, high) in ranges.items()
    )
    return Observable("position", tuple(features), lambda r: r.qpos[:, POSITION])


_MOTION = (
    _observable(
        "orientation", "w x y z", "1", (1, 1, 1, 1), lambda r: r.qpos[:, QUATERNION], "quaternion"
    ),
    _observable(
        "velocity", "x y z", "m/s", (1, 1, 1), lambda r: r.qvel[:, VELOCITY], "vector", "world"
    ),
    _observable(
        "angular_velocity",
        "x y z",
        "rad/s",
        (35, 35, 35),
        lambda r: r.qvel[:, SPIN],
        "vector",
        "body",
    ),
    _observable("motor_angle", "", "rad", (np.pi,), lambda r: r.motor_angle[:, None], "angle"),
    _observable("motor_velocity", "", "rad/s", (180,), lambda r: r.qvel[:, MOTOR_QVEL, None]),
)
_SHARED = (_position("point"), *_MOTION)
_ANGLE_TO_TARGET = _observable(
    "angle_to_target", "", "rad", (np.pi,), lambda r: r.angle_to_target[:, None], "angle"
)
_TARGET_VELOCITY = _observable(
    "velocity_in_target_frame", "x y z", "m/s", (1, 1, 1), lambda r: r.velocity_in_target_frame
)
_TARGET_POSITION = _observable(
    "target", "x y z", "m", (3, 3, 0.1), lambda r: r.target_in_bug_frame, "offset", "body"
)


# Each term equals the call of `dm_control.utils.rewards.tolerance` in its docstring, with fewer
# array operations: terms are evaluated at every step.


def upright_term(r: Readings) -> Array:
    """1 standing, 0.1 at a tilt of 60 degrees.

    tolerance(uprightness, bounds=(1, 1), margin=0.5, sigmoid="gaussian", value_at_margin=0.1)
    """
    return _VALUE_AT_MARGIN ** ((1 - r.uprightness) / _UPRIGHT_MARGIN) ** 2


def position_term(r: Readings) -> Array:
    """1 at the target, 0.1 at 5 cm from it.

    tolerance(distance, bounds=(0, 0), margin=0.05, sigmoid="gaussian", value_at_margin=0.1)
    """
    return _VALUE_AT_MARGIN ** (r.distance_to_target / _POSITION_MARGIN) ** 2


def away_term(r: Readings) -> Array:
    """0 at the target, 0.9 at 5 cm from it: 1 - position_term."""
    return 1 - position_term(r)


def heading_term(r: Readings) -> Array:
    """1 facing along the target's yaw, 0 from 90 degrees on.

    tolerance(angle, bounds=(0, 0), margin=pi / 2, sigmoid="cosine", value_at_margin=0)
    """
    return np.maximum(np.cos(r.angle_to_target), 0) ** 2


def velocity_term(r: Readings) -> Array:
    """0 at rest, 1 from 0.1 m/s along the target's yaw on.

    tolerance(velocity_x, bounds=(0.1, inf), margin=0.1, sigmoid="linear", value_at_margin=0)
    """
    return np.minimum(np.maximum(r.velocity_in_target_frame[:, 0] / _TARGET_SPEED, 0), 1)


@dataclass(frozen=True)
class JitterbugTask:
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
    def plain(self) -> Task:
        """The task as plain data, with the usual time limit."""
        return self.describe()

    @cached_property
    def _start_ranges(self) -> Array:
        tilt = (-_MAX_TILT, _MAX_TILT)
        return np.array([_TURN, tilt, tilt, self.target_radius, _TURN, self.target_yaw]).T

    def describe(
        self, arguments: Mapping[str, Any] | None = None, max_episode_steps: int | None = None
    ) -> Task:
        """The task as plain data, of an environment with these arguments and time limit."""
        steps = EPISODE_STEPS if max_episode_steps is None else max_episode_steps
        given = dict(arguments or {})
        body = {"body": 1} if given.get("body") is not None else {}
        return Task(
            id=environment_id(self.name),
            name=self.name,
            features=tuple(f for each in self.observables for f in each.features),
            action_low=(-1.0,),
            action_high=(1.0,),
            max_episode_steps=steps,
            arguments=given,
            timestep=CONTROL_TIMESTEP,
            reward_low=0.0,
            reward_high=1.0,
            solved_return=SOLVED_REWARD * steps,
            terminates=False,
            draws=START_DRAWS,
            state={"qpos": QPOS_SIZE, "qvel": QVEL_SIZE},
            constants={"target_position": 3, "target_quaternion": 4, **body},
        )

    def observe(self, readings: Readings) -> Array:
        """The flat observation in physical units, (n, d)."""
        return np.concatenate([o.read(readings) for o in self.observables], axis=1)

    def reward(self, readings: Readings) -> Array:
        """The reward in [0, 1], (n,)."""
        reward = upright_term(readings)
        for term in self.terms:
            reward = reward * term(readings)
        return reward

    def start(self, random: np.random.Generator | np.random.RandomState) -> Start:
        """Draw how an episode begins.

        Every task makes the same six draws, so a seed gives the same motion in all tasks.
        """
        low, high = self._start_ranges
        turn, tilt_x, tilt_y, radius, bearing, yaw = random.uniform(low, high)
        axis = np.array([tilt_x, tilt_y, 1.0]) / np.sqrt(tilt_x**2 + tilt_y**2 + 1)
        return Start(
            np.append(np.cos(turn / 2), np.sin(turn / 2) * axis),
            np.array([radius * np.cos(bearing), radius * np.sin(bearing), _TARGET_HEIGHT]),
            np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]),
        )


_ALL = (
    JitterbugTask("move_from_origin", "easy", (_position("offset"), *_MOTION), (away_term,)),
    JitterbugTask(
        "face_direction", "easy", (*_SHARED, _ANGLE_TO_TARGET), (heading_term,), target_yaw=_TURN
    ),
    JitterbugTask(
        "move_in_direction",
        "easy",
        (*_SHARED, _ANGLE_TO_TARGET, _TARGET_VELOCITY),
        (velocity_term,),
        target_yaw=_TURN,
    ),
    JitterbugTask(
        "move_to_position",
        "hard",
        (*_SHARED, _TARGET_POSITION),
        (position_term,),
        target_radius=_TARGET_RADIUS,
    ),
    JitterbugTask(
        "move_to_pose",
        "hard",
        (*_SHARED, _TARGET_POSITION, _ANGLE_TO_TARGET),
        (position_term, heading_term),
        target_radius=_TARGET_RADIUS,
        target_yaw=_TURN,
    ),
)
TASKS = {task.name: task for task in _ALL}


def get_task(name: str) -> JitterbugTask:
    """Look up a task by its name."""
    return choose(name, TASKS, "task")


def environment_id(task: str) -> str:
    """Gymnasium's id of a task: `face_direction` is `Jitterbug/FaceDirection-v0`."""
    return f"Jitterbug/{task.title().replace('_', '')}-v0"


def jitterbug_task(task: Task) -> JitterbugTask | None:
    """The task as the Jitterbug's own; None for another robot's, or if not all of it is seen."""
    if task.view:
        return None
    return next((own for own in TASKS.values() if environment_id(own.name) == task.id), None)


def register() -> None:
    """Register the five tasks and their short names; with jbrep, Gymnasium's import calls this."""
    import gymnasium

    for name in TASKS:
        SHORT_NAMES[name] = environment_id(name)
        gymnasium.register(
            environment_id(name),
            entry_point="jbrep.jitterbug.gym:JitterbugEnv",
            vector_entry_point="jbrep.jitterbug.gym:JitterbugVectorEnv",
            max_episode_steps=EPISODE_STEPS,
            reward_threshold=SOLVED_REWARD * EPISODE_STEPS,
            kwargs={"task": name},
        )
