"""What lanes are given, checked."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.errors import InputError


class NonFiniteActionError(InputError):
    """An action is NaN or infinite."""


def check_counts(num_lanes: int, num_threads: int | None) -> None:
    """Check the numbers of lanes and threads.

    Raises:
        InputError: a number below 1.
    """
    for count, what in ((num_lanes, "lanes"), (num_threads, "threads")):
        if count is not None and count < 1:
            raise InputError(f"the number of {what} is {count}: it must be at least 1")


def check_actions(actions: ArrayLike, num_lanes: int, size: int) -> NDArray[np.float64]:
    """The actions as (num_lanes, size) float64.

    Raises:
        InputError: another shape.
        NonFiniteActionError: a value that is not finite.
    """
    checked: NDArray[np.float64] = np.asarray(actions, dtype=np.float64)
    if checked.shape != (num_lanes, size):
        raise InputError(
            f"actions have shape {checked.shape}: it must be ({num_lanes}, {size}), one action for "
            "each lane"
        )
    if not math.isfinite(checked.sum()) and not np.isfinite(checked).all():
        raise NonFiniteActionError(f"actions are not finite: {checked.ravel()}")
    return checked
