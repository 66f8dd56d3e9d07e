"""The same robots elsewhere in the world, and the same states in other numbers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.coordinates.coordinates import in_range, wrapped
from jbrep.coordinates.made import attitude_of, units
from jbrep.envs.task import Task

Array = NDArray[np.float64]


def placed(task: Task, rows: Array, like: NDArray[Any]) -> Array:
    """The same robots, in observations (n, d), turned and shifted to where those `like` them stand.

    They get the headings of the others, and the x and y of their first point in the world, if they
    have one. All else stays as seen from the robot.
    """
    moved, turn = rows.copy(), _heading(task, like) * _heading(task, rows).conj()
    half = np.sqrt(turn)  # of the turn: half its angle
    shift: Array | None = None
    for place, unit in units(task):
        if unit[0].kind == "quaternion":
            w, x, y, z = rows[:, place].T
            upright, tilted = (w + 1j * z) * half, (x + 1j * y) * half
            parts = upright.real, tilted.real, tilted.imag, upright.imag
            moved[:, place] = np.column_stack(parts)
        elif unit[0].frame == "world" and unit[0].kind == "angle":
            moved[:, place.start] = in_range(rows[:, place.start] + np.angle(turn), unit[0])
        elif unit[0].frame == "world":
            first = slice(place.start, place.start + 2)
            plane = (rows[:, first] @ (1, 1j)) * turn
            moved[:, first] = np.column_stack((plane.real, plane.imag))
            if unit[0].kind == "point":
                shift = like[:, first] - moved[:, first] if shift is None else shift
                moved[:, first] += shift
    return moved


def _heading(task: Task, rows: NDArray[Any]) -> NDArray[np.complex128]:
    """Where robots head, (n,), as numbers on the unit circle."""
    names = attitude_of(task)
    if not names:
        return np.ones(len(rows), complex)
    columns = rows[:, [task.feature_names.index(name) for name in names]].T
    if len(names) == 1:
        return np.exp(1j * columns[0])
    half = columns[0] + 1j * columns[3]
    size = np.abs(half)
    return np.where(size > 0, half / np.where(size > 0, size, 1), 1) ** 2


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
