"""What a task is, as plain data: data sets, encoders and runs carry it, and need no environment."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from jbrep.errors import InputError
from jbrep.records.typed import typed
from jbrep.text import slug

Array = NDArray[np.float64]
_Float = TypeVar("_Float", bound=np.floating[Any])

MAX_EPISODE_STEPS = 1_000_000
SEED_BITS = (63, 31)  # that an environment may take
_MAX_FEATURES = 4096
_MAX_ACTIONS = 1024
_WORD = re.compile(r"[A-Za-z][\w.-]{0,99}", re.ASCII)
_ID = re.compile(r"(\w[\w-]{0,99}/)?\w[\w.-]{0,99}", re.ASCII)  # no part of a path leads upwards
_MAX_UNIT = 40  # letters


@dataclass(frozen=True)
class Feature:
    """One number of an observation."""

    name: str
    unit: str = ""
    low: float | None = None  # usual range, None where it isn't known
    high: float | None = None
    bounded: bool = False  # whether it never leaves that range
    group: str = ""  # of the features that belong together

    def __str__(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def is_angle(self) -> bool:
        """Whether it jumps from one end of its range to the other, a full turn apart."""
        if self.unit != "rad" or not self.bounded or self.low is None or self.high is None:
            return False
        return math.isclose(self.high - self.low, 2 * math.pi, rel_tol=0.01)


@dataclass(frozen=True)
class Task:
    """An environment with its arguments and time limit, described without making it.

    Args:
        id: in Gymnasium's registry.
        name: what commands and tables call it: the id, or a short name.
        features: of the flat observation, in order.
        action_low, action_high: bounds of each number of an action.
        max_episode_steps: the time limit [steps].
        arguments: of the environment, as `gymnasium.make` takes them; plain JSON.
        timestep: from one step to the next [s], None where it isn't known.
        reward_low, reward_high: bounds of a reward, None where there are none or aren't known.
        solved_return: of an episode, from which the task counts as solved; None if there is none.
        terminates: whether a state can end an episode before the time limit; None if unknown.
        reproducible: whether the same seed and actions give the same bits.
        seed_bits: size of the seeds that it takes.
        draws: random numbers that it draws in an episode, each of 64 bits, from NumPy's default
            generator with the episode's seed; None if unknown.
        state: the arrays that `info` has of each state, by name, with their widths.
        constants: those that stay the same during an episode.

    Raises:
        ValueError: a field that doesn't fit this description.
    """

    id: str
    name: str
    features: tuple[Feature, ...]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    max_episode_steps: int
    arguments: Mapping[str, Any] = field(default_factory=dict)
    timestep: float | None = None
    reward_low: float | None = None
    reward_high: float | None = None
    solved_return: float | None = None
    terminates: bool | None = None
    reproducible: bool = True
    seed_bits: int = SEED_BITS[0]
    draws: int | None = None
    state: Mapping[str, int] = field(default_factory=dict)
    constants: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, what in (("id", self.id), ("name", self.name)):
            if not _ID.fullmatch(what):
                raise ValueError(f"its {name} is {what!r}: it must be as in Namespace/Name-v0")
        if not 1 <= self.max_episode_steps <= MAX_EPISODE_STEPS:
            raise ValueError(
                f"the number of steps in an episode is {self.max_episode_steps}: it must be at "
                f"least 1 and at most {MAX_EPISODE_STEPS:,}"
            )
        if self.seed_bits not in SEED_BITS or not (self.draws is None or 0 <= self.draws < 1 << 32):
            raise ValueError("its seeds or draws are out of range")
        if self.timestep is not None and self.timestep <= 0:
            raise ValueError(f"the time step is {self.timestep:g}: it must be above 0")
        try:
            json.dumps(self.arguments, allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise ValueError("its arguments must be plain JSON, all numbers finite") from None
        self._check_features()
        self._check_ranges()
        self._check_actions()

    def _check_features(self) -> None:
        if not 1 <= self.size <= _MAX_FEATURES or len(set(self.feature_names)) < self.size:
            raise ValueError(f"it must have 1 to {_MAX_FEATURES:,} features of different names")
        if sum(place.stop - place.start for place in self.groups.values()) != self.size:
            raise ValueError("features of a group must stand side by side")
        for word in (*self.feature_names, *self.groups, *self.arrays):
            if not _WORD.fullmatch(word):
                raise ValueError(f"the name {word!r} must be a letter, then letters, digits or ._-")
        if self.state.keys() & self.constants.keys():
            raise ValueError("the arrays that move and those that don't must have different names")
        if any(not 1 <= width <= _MAX_FEATURES for width in self.arrays.values()):
            raise ValueError(f"an array of its states must have 1 to {_MAX_FEATURES:,} numbers")

    def _check_ranges(self) -> None:
        for feature in self.features:
            if len(feature.unit) > _MAX_UNIT or not feature.unit.isprintable():
                raise ValueError(f"the unit of {feature.name} must be a word")
        ranges = [(feature.name, feature.low, feature.high) for feature in self.features]
        for name, low, high in (*ranges, ("a reward", self.reward_low, self.reward_high)):
            if low is not None and high is not None and low > high:
                raise ValueError(f"the range of {name} is from {low:g} to {high:g}: swap them")

    def _check_actions(self) -> None:
        bounds = list(zip(self.action_low, self.action_high, strict=False))
        if len(self.action_low) != len(self.action_high):
            raise ValueError("its actions must have as many lower bounds as upper ones")
        if not 1 <= len(bounds) <= _MAX_ACTIONS or not all(
            math.isfinite(low) and math.isfinite(high) and low < high for low, high in bounds
        ):
            raise ValueError(f"its actions must have 1 to {_MAX_ACTIONS:,} numbers, finite bounds")

    @property
    def slug(self) -> str:
        """The name as a part of paths."""
        return slug(self.name)

    @property
    def size(self) -> int:
        """Length d of the flat observation."""
        return len(self.features)

    @property
    def action_size(self) -> int:
        """Length k of an action."""
        return len(self.action_low)

    @cached_property
    def feature_names(self) -> tuple[str, ...]:
        """Names of all features, in order."""
        return tuple(feature.name for feature in self.features)

    @cached_property
    def groups(self) -> dict[str, slice]:
        """Where the features of each group stand; features without one are groups of their own."""
        groups: dict[str, slice] = {}
        for i, feature in enumerate(self.features):
            name = feature.group or feature.name
            groups[name] = slice(groups[name].start if name in groups else i, i + 1)
        return groups

    @property
    def arrays(self) -> dict[str, int]:
        """What `info` has of each state: what moves and what is constant, with their widths."""
        return {**self.state, **self.constants}

    @property
    def return_floor(self) -> float | None:
        """The least possible return of an episode; None where none is known."""
        if self.reward_low is None:
            return None
        return min(self.reward_low, 0.0) * self.max_episode_steps

    @property
    def return_ceiling(self) -> float | None:
        """The largest possible return of an episode; None where none is known."""
        if self.reward_high is None:
            return None
        return max(self.reward_high, 0.0) * self.max_episode_steps

    @cached_property
    def _centre(self) -> Array:
        return np.array([(f.high + f.low) / 2 if _ranged(f) else 0 for f in self.features])  # type: ignore[operator]

    @cached_property
    def _half_width(self) -> Array:
        return np.array([(f.high - f.low) / 2 if _ranged(f) else 1 for f in self.features])  # type: ignore[operator]

    def scale(self, observation: Array) -> Array:
        """Scale to about [-1, 1] by the usual ranges, (..., d); features without one stay."""
        return (observation - self._centre) / self._half_width

    def unscale(self, scaled: Array) -> Array:
        """The inverse of `scale`."""
        return scaled * self._half_width + self._centre

    def split(self, observation: NDArray[_Float]) -> dict[str, NDArray[_Float]]:
        """Split flat observations (..., d) by group; the parts are views."""
        return {name: observation[..., place] for name, place in self.groups.items()}

    def as_json(self) -> dict[str, Any]:
        """The description as plain JSON, which `read_task` takes."""
        record = asdict(self)
        record["features"] = [list(asdict(feature).values()) for feature in self.features]
        return {n: list(v) if isinstance(v, tuple) else v for n, v in record.items()}


def read_task(record: Any) -> Task:
    """A task from plain JSON, perhaps a stranger's, every field checked.

    Raises:
        ValueError: it isn't a task's description; the message says why.
    """
    if not isinstance(record, dict) or not isinstance(record.get("features"), list):
        raise ValueError("a task must be an object with features")
    names = Feature.__dataclass_fields__
    rows = record["features"]
    if not all(isinstance(row, list) and len(row) == len(names) for row in rows):
        raise ValueError(f"each feature must be a list of {len(names)}")
    named = [dict(zip(names, row, strict=True)) for row in rows]
    try:
        task: Task = typed({**record, "features": named}, Task)
    except RecursionError:
        raise ValueError("its arguments are nested too deeply") from None
    return task


def _ranged(feature: Feature) -> bool:
    low, high = feature.low, feature.high
    return low is not None and high is not None and low < high


def check_same(expected: Task, actual: Task, what: str) -> None:
    """Make sure that two descriptions are of the same observations.

    Args:
        expected: the task at hand.
        actual: the one that something was made for; another body of the same robot will do.
        what: was made for it, for the message.

    Raises:
        InputError: another environment, or other features.
    """
    if actual.id != expected.id:
        raise InputError(
            f"{what} was made for {actual.name}, not for {expected.name}: use one made for "
            f"{expected.name}"
        )
    if actual.feature_names != expected.feature_names:
        raise InputError(f"{what} was made for other features of {actual.name}")
