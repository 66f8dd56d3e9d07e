"""Moving robots in the world: what symmetry leaves out, put back from somewhere else."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.coordinates.coordinates import in_range
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
