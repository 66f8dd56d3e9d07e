"""The robot's state in terms of heading, speed and angles, computed from observations."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.jitterbug.tasks import Task

Array = NDArray[np.float64]

_REPLACED = ("orientation_w", "orientation_x", "orientation_y", "orientation_z")
_ANGLES = ("motor_angle", "angle_to_target")


def quantities(task: Task, observation: ArrayLike) -> dict[str, Array]:
    """What a controller needs to know from observations (n, d) in physical units.

    Angles are cosine and sine, (n, 2); the rest is (n, 1): the heading of the robot's face in the
    world, its uprightness (cosine of the tilt), its forward speed [m/s], the motor's phase, and, if
    the task has them, the angle to the target's yaw and the bearing of the target's position from
    the face, counter-clockwise.
    """
    return _quantities(_features(task, observation))


def state(task: Task, observation: ArrayLike) -> dict[str, Array]:
    """The whole state as columns (n,) by name: the quantities above and all other features."""
    features = _features(task, observation)
    columns: dict[str, Array] = {}
    for name, values in _quantities(features).items():
        endings = ("_cos", "_sin") if values.shape[1] == 2 else ("",)
        columns |= {name + end: column for end, column in zip(endings, values.T, strict=True)}
    others = features.keys() - {*_REPLACED, *_ANGLES}
    return columns | {name: features[name] for name in features if name in others}


def _features(task: Task, observation: ArrayLike) -> dict[str, Array]:
    columns = np.asarray(observation, np.float64).T
    return dict(zip(task.feature_names, columns, strict=True))


def _quantities(f: dict[str, Array]) -> dict[str, Array]:
    w, x, y, z = (f[name] for name in _REPLACED)
    face = _direction(2 * (w * z - x * y), 2 * (x * x + z * z) - 1)  # the robot's -Y axis
    speed = face[:, 0] * f["velocity_x"] + face[:, 1] * f["velocity_y"]
    columns = {
        "heading": face,
        "uprightness": (1 - 2 * (x * x + y * y))[:, None],
        "forward_speed": speed[:, None],
        "motor_phase": _direction(np.cos(f["motor_angle"]), np.sin(f["motor_angle"])),
    }
    if "angle_to_target" in f:
        angle = f["angle_to_target"]
        columns["angle_to_target"] = _direction(np.cos(angle), np.sin(angle))
    if "target_x" in f:
        columns["bearing_of_target"] = _direction(-f["target_y"], f["target_x"])
    return columns


def _direction(x: Array, y: Array) -> Array:
    """Unit vectors along (x, y), (n, 2); zero vectors stay zero."""
    length = np.maximum(np.hypot(x, y), 1e-12)
    return np.stack((x / length, y / length), axis=1)
