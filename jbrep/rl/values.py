"""The values that a setting may have, from the types that stable-baselines3 declares."""

import json
import math
import re
import types
import typing
from collections.abc import Callable
from typing import Any

from jbrep.errors import InputError
from jbrep.rl.fields import MAX_ENVS

_LINEAR = re.compile(r"linear:((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e-?[0-9]{1,2})?)")
_MOST = 1e9  # of any number
_RANGES: dict[str, tuple[float, float]] = {  # others: from 1 if whole, else from 0
    **dict.fromkeys(("gamma", "tau", "gae_lambda", "batch_norm_momentum"), (0, 1)),
    **dict.fromkeys(("gradient_steps", "sde_sample_freq"), (-1, _MOST)),
    **dict.fromkeys(("learning_starts", "top_quantiles_to_drop_per_net"), (0, _MOST)),
    "renorm_warmup_steps": (0, _MOST),
    "target_entropy": (-_MOST, _MOST),
    "log_std_init": (-20, 20),
    "n_critics": (1, 10),
    "n_quantiles": (1, 200),
    "num_envs": (1, MAX_ENVS),
}


def typed(name: str, value: Any, annotation: Any) -> Any:
    """The value, if a parameter of that name and type may have it.

    Raises:
        InputError: it may not.
    """
    kinds = typing.get_args(annotation) if _is_union(annotation) else (annotation,)
    if value == "none" and types.NoneType in kinds:  # TOML has no null
        return None
    words = [word for kind in kinds for word, fits in [_kind(kind)] if word]
    if not any(fits(value) for _, fits in map(_kind, kinds)):
        raise refused(name, value, " or ".join(words))
    if is_number(value):
        least, most = _RANGES.get(name, (1 if int in kinds else 0, _MOST))
        if not least <= value <= most:
            raise refused(name, value, f"a number from {least:,} to {most:,.0f}")
        return value if int in kinds else float(value)
    return value


def _kind(annotation: Any) -> tuple[str, Callable[[Any], bool]]:
    """What a type allows of JSON's values, in words and as a predicate."""
    origin = typing.get_origin(annotation)
    if annotation is int:
        return "a whole number", lambda value: type(value) is int
    if annotation is float:
        return "a number", is_number
    if annotation is bool:
        return "true or false", lambda value: isinstance(value, bool)
    if annotation is str:
        return "text", lambda value: isinstance(value, str)
    if annotation is types.NoneType:
        return "none", lambda value: value is None
    if origin is tuple:
        return '[1, "episode"]', _is_frequency
    if Callable in (annotation, origin):
        return "linear:NUMBER", _is_schedule
    return "", lambda value: False


def _is_union(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)


def is_number(value: Any) -> bool:
    """Whether a value is a finite number."""
    return type(value) in (int, float) and math.isfinite(value)


def _is_frequency(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and type(value[0]) is int
        and value[0] > 0
        and value[1] in ("step", "episode")
    )


def _is_schedule(value: Any) -> bool:
    return isinstance(value, str) and linear_from(value) is not None


def refused(name: str, value: Any, expected: str) -> InputError:
    """The error for a value that a setting can't have."""
    shown = value if isinstance(value, str) else json.dumps(value)
    return InputError(f"{name} is {shown}: it must be {expected}")


def linear_from(text: str) -> float | None:
    """The number from which a linear schedule to 0 starts; None if the text isn't one."""
    number = _LINEAR.fullmatch(text)
    return float(number[1]) if number else None
