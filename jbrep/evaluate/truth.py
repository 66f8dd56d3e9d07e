"""The ground truth of a robot, computed from its observations: what a latent is searched for."""

import numpy as np
from numpy.typing import ArrayLike

from jbrep.envs.task import Array, Task
from jbrep.jitterbug.tasks import TASKS

Columns = dict[str, Array]

_ROTATION = ("orientation_w", "orientation_x", "orientation_y", "orientation_z")
_NEEDED = {*_ROTATION, "velocity_x", "velocity_y", "motor_angle"}  # features, for the quantities


def quantities(task: Task, observation: ArrayLike) -> Columns:
    """What a controller needs to know from observations (n, d) in physical units.

    An angle is its cosine and sine, (n, 2); the rest is (n, 1). Of the Jitterbug: the heading of
    its face in the world, its uprightness (cosine of the tilt), its forward speed [m/s], the
    motor's phase, and, if the task has them, the angle to the target's yaw and the bearing of the
    target's position from the face, counter-clockwise. Of any other robot: every feature; it is an
    angle if its unit is rad and it is bounded to one turn.
    """
    is_known = task.name in TASKS and {*task.feature_names} >= _NEEDED and not task.offset.any()
    return _jitterbug(_features(task, observation)) if is_known else every(task, observation)


def quantities_and_features(task: Task, observation: ArrayLike) -> Columns:
    """The quantities, then the features that aren't among them; all angles as cosine and sine."""
    known, features = quantities(task, observation), every(task, observation)
    return known | {name: features[name] for name in features if name not in known}


def every(task: Task, observation: ArrayLike) -> Columns:
    """All features, (n, k) by name: angles as cosine and sine."""
    angles = {feature.name for feature in task.features if feature.is_full_turn}
    return {
        name: _on_circle(column) if name in angles else column[:, None]
        for name, column in _features(task, observation).items()
    }


def _features(task: Task, observation: ArrayLike) -> Columns:
    columns = np.asarray(observation, np.float64).T
    return dict(zip(task.feature_names, columns, strict=True))


def _jitterbug(f: Columns) -> Columns:
    w, x, y, z = (f[name] for name in _ROTATION)
    face = _direction(2 * (w * z - x * y), 2 * (x * x + z * z) - 1)  # the robot's -Y axis
    speed = face[:, 0] * f["velocity_x"] + face[:, 1] * f["velocity_y"]
    columns = {
        "heading": face,
        "uprightness": (1 - 2 * (x * x + y * y))[:, None],
        "forward_speed": speed[:, None],
        "motor_phase": _on_circle(f["motor_angle"]),
    }
    if "angle_to_target" in f:
        columns["angle_to_target"] = _on_circle(f["angle_to_target"])
    if "target_x" in f:
        columns["bearing_of_target"] = _direction(-f["target_y"], f["target_x"])
    return columns


def _on_circle(angle: Array) -> Array:
    """Cosine and sine, (n, 2)."""
    return np.stack((np.cos(angle), np.sin(angle)), axis=1)


def _direction(x: Array, y: Array) -> Array:
    """Unit vectors along (x, y), (n, 2); zero vectors stay zero."""
    length = np.maximum(np.hypot(x, y), 1e-12)
    return np.stack((x / length, y / length), axis=1)
