"""The same states in other numbers: an angle and whole turns, a quaternion of either sign."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.coordinates.coordinates import wrapped
from jbrep.coordinates.made import units
from jbrep.envs.task import Task


def nearest(task: Task, rows: NDArray[Any], like: NDArray[Any]) -> NDArray[Any]:
    """Observations in the numbers that are nearest to those of others, (n, d)."""
    found = rows.copy()
    for place, unit in units(task):
        of, other = rows[:, place], like[:, place]
        if unit[0].kind == "quaternion":
            found[:, place] = of * _sign(of, other)
        elif unit[0].is_angle:
            found[:, place] = other + wrapped(of - other)
    return found


def continuous(task: Task, rows: NDArray[Any]) -> NDArray[Any]:
    """Observations (n, d) along a path in numbers that don't jump."""
    found = rows.copy()
    for place, unit in units(task):
        of = rows[:, place]
        if unit[0].kind == "quaternion":
            found[1:, place] = of[1:] * np.cumprod(_sign(of[1:], of[:-1]), axis=0)
        elif unit[0].is_angle:
            found[:, place] = np.unwrap(of, axis=0)
    return found


def _sign(quaternions: NDArray[Any], others: NDArray[Any]) -> NDArray[Any]:
    """-1 where a quaternion is nearer to another with the other sign, else 1, (n, 1)."""
    along = (quaternions * others).sum(axis=1, keepdims=True)
    return np.where(along < 0, -1, 1).astype(quaternions.dtype)
