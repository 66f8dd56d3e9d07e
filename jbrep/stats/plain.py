"""Results as plain JSON values, and back."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from jbrep.stats.bootstrap import Array, Interval, without_nan


def to_plain(value: Any) -> Any:
    """Dataclasses, intervals and arrays as dicts and lists; None stands for what isn't finite."""
    if isinstance(value, Interval):
        return value.tolist()
    if is_dataclass(value):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: to_plain(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return [to_plain(part) for part in value]
    if isinstance(value, np.ndarray | float):
        return without_nan(np.asarray(value).tolist())
    return value


def _array(value: Any) -> Array:
    """Numbers (n,), NaN for null."""
    array = np.array(value, float)
    if array.ndim != 1 or np.isinf(array).any():
        raise ValueError("must be a list of finite numbers")
    return array


def _interval(value: Any) -> Interval:
    """An interval of a number, (3,), or of numbers, (n, 3)."""
    array = np.array(value, float)
    if array.ndim not in (1, 2) or array.shape[-1] != 3 or np.isinf(array).any():
        raise ValueError("must be [value, low, high], or a list of these")
    parts = np.moveaxis(array, -1, 0)
    return Interval(*(parts if array.ndim > 1 else parts.tolist()))


def _number(value: Any) -> float:
    """A number, NaN for null."""
    if value is None:
        return np.nan
    if type(value) not in (int, float) or not np.isfinite(float(value)):
        raise ValueError("must be a number or null")
    return float(value)


READERS = {Array: _array, Interval: _interval, float: _number}  # for jbrep.records.typed
