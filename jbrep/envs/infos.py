"""Numbers that an environment tells in `info` beside its observations, such as is_success."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jbrep.records.record import MOST_WHOLE
from jbrep.text import counted

SUCCESS = "is_success"  # what robots of Gymnasium and stable-baselines3 call it
Numbers = dict[str, float]  # by name; of a truth, 1 or 0
_MAX_NAME = 64
_OF_STEPS = "timestep."  # begins what Shimmy tells of dm_control's steps: whether they are the last


def number_of(value: Any) -> float | None:
    """A truth, a whole number or a float, of Python or of NumPy; None of anything else.

    That includes arrays, and numbers that are not finite or beyond 2^53.
    """
    if isinstance(value, np.generic):
        value = value.item()
    is_number = isinstance(value, bool | int | float) and abs(value) <= MOST_WHOLE
    return float(value) if is_number else None


def numbers_in(info: Mapping[str, Any]) -> Numbers:
    """The numbers in an environment's `info`, in its order; those with printable names."""
    pairs = ((name, number_of(value)) for name, value in info.items() if _is_name(name))
    return {name: value for name, value in pairs if value is not None}


def by_name(episodes: Iterable[Mapping[str, float]]) -> dict[str, list[float]]:
    """Each number in the episodes that tell it."""
    found: dict[str, list[float]] = {}
    for episode in episodes:
        for name, value in episode.items():
            found.setdefault(name, []).append(value)
    return found


def shares(values: Mapping[str, list[float]]) -> dict[str, list[float]]:
    """Those numbers that are 0 or 1 in every episode, so that their mean is a share."""
    return {
        name: each
        for name, each in values.items()
        if {*each} <= {0.0, 1.0} and not name.startswith(_OF_STEPS)
    }


def shares_text(values: Mapping[str, list[float]]) -> str:
    """The shares for a reader: is_success 0.84 in 50 episodes."""
    return "; ".join(
        f"{name} {np.mean(each):.2f} in {counted(len(each), 'episode')}"
        for name, each in shares(values).items()
    )


def _is_name(name: Any) -> bool:
    return isinstance(name, str) and name.isprintable() and 0 < len(name) <= _MAX_NAME
