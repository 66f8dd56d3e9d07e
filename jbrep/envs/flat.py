"""Observations of any structure as one flat array."""

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten
from numpy.typing import NDArray

Flatten = Callable[[Any], NDArray[Any]]


def flattener(space: spaces.Space[Any]) -> Flatten:
    """What `gymnasium.spaces.utils.flatten` does for a space, made once instead of at each step."""
    if isinstance(space, spaces.Box):
        return np.ravel
    if isinstance(space, spaces.Dict):
        parts = [(key, flattener(part)) for key, part in space.spaces.items()]
        return lambda given: np.concatenate([flat(given[key]) for key, flat in parts])
    if isinstance(space, spaces.Tuple):
        each = [flattener(part) for part in space.spaces]
        return lambda given: np.concatenate([f(part) for f, part in zip(each, given, strict=True)])
    return lambda given: np.asarray(flatten(space, given))
