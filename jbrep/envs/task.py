"""What a task is, as plain data: data sets, encoders and runs carry it, and need no environment."""

import json
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import groupby
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from msgspec import UNSET, Meta, UnsetType
from numpy.typing import NDArray

from jbrep.envs.domain import Domain
from jbrep.errors import InputError
from jbrep.records.record import Finite, Record, Sha256, pattern
from jbrep.text import slug

Array = NDArray[np.float64]
_Float = TypeVar("_Float", bound=np.floating[Any])

MAX_EPISODE_STEPS = 1_000_000
SeedBits = Literal[63, 31]
WIDE_SEEDS: SeedBits = 63  # bits of the seeds that most environments take
NARROW_SEEDS: SeedBits = 31  # and of those of others
MAX_FEATURES = 4000  # an attribute of HDF5 holds their names
_MAX_ACTIONS = 1024
_LETTERS = "letters of ASCII, digits, '_', '-' and '.'"
EpisodeSteps = Annotated[int, Meta(ge=1, le=MAX_EPISODE_STEPS)]
Word = Annotated[
    str, pattern(r"(?a)\A[A-Za-z][\w.-]{0,99}\Z", f"a letter, then up to 99 {_LETTERS}")
]
Id = Annotated[  # no part of a path leads upwards
    str,
    pattern(r"(?a)\A(\w[\w-]{0,99}/)?\w[\w.-]{0,99}\Z", "an id such as Hopper-v5 or its/Hopper-v5"),
]
_Group = Annotated[
    str,
    pattern(r"(?a)\A([A-Za-z][\w.-]{0,99})?\Z", f"empty, or a letter, then up to 99 {_LETTERS}"),
]
_Unit = Annotated[str, pattern(r"\A[^\x00-\x1f\x7f-\x9f]{0,40}\Z", "a line of up to 40 letters")]
Kind = Literal["scalar", "angle", "quaternion", "vector", "offset", "point"]
Frame = Literal["", "world", "body", "heading"]
SPATIAL: Mapping[Kind, range] = {  # kinds of several features, a group of their own; of how many
    "quaternion": range(4, 5),
    "vector": range(2, 4),
    "offset": range(2, 4),
    "point": range(2, 4),
}
_Positive = Annotated[float, Meta(gt=0, le=1e12)]
_Part = Annotated[str, pattern(r"\A[^\x00-\x1f\x7f-\x9f]{1,200}\Z", "a line of 1 to 200 letters")]
Missing = Annotated[
    str, pattern(r"\A(skip|hold:[1-9]\d{0,5})\Z", "skip, or hold:N with N from 1 on")
]
_Arrays = Mapping[Word, Annotated[int, Meta(ge=1, le=MAX_FEATURES)]]
_Bounds = Annotated[tuple[Finite, ...], Meta(min_length=1, max_length=_MAX_ACTIONS)]

SHORT_NAMES: dict[str, str] = {}  # ids of tasks by other names; a robot that ships adds its own


class Feature(Record, frozen=True, array_like=True):
    """One number of an observation.

    Its kind says how it changes when the robot, or the world, is turned and shifted: a `scalar`
    doesn't; an `angle` is in rad; a `quaternion` is the four numbers w, x, y, z that turn the body
    into the world; a `vector`, such as a velocity or a force, is turned; an `offset` from one place
    to another is turned, too, and has a length and a direction; a `point` in the world is turned
    and shifted. The last three are x and y, or x, y and z, in the frame of the world, the body, or
    its heading (turned about the vertical only).
    """

    name: Word
    unit: _Unit = ""
    low: Finite | None = None  # usual range, None where it isn't known
    high: Finite | None = None
    bounded: bool = False  # whether it never leaves that range
    group: _Group = ""  # of the features that belong together
    kind: Kind = "scalar"
    frame: Frame = ""  # of an angle: world, or relative to something

    def check(self) -> None:
        _check_range(self.name, self.low, self.high)
        if self.kind in ("vector", "offset", "point") and not self.frame:
            raise InputError(
                f"{self.name} is a {self.kind}: its frame must be world, body or heading"
            )
        if self.kind == "point" and self.frame != "world":
            raise InputError(f"{self.name} is a point: its frame must be world; or it is an offset")
        if self.is_angle and self.unit not in ("rad", ""):
            raise InputError(f"{self.name} is an angle in {self.unit}: it must be in rad")
        if self.is_angle and self.frame not in ("", "world"):
            raise InputError(f"{self.name} is an angle: its frame must be world, or left out")
        if self.is_angle and self.bounded and not self.is_full_turn:
            raise InputError(
                f"{self.name} is an angle that stays in its range, which must be a full turn: from "
                "-pi to pi, or from 0 to 2 pi; or say that it isn't bounded"
            )

    def __str__(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def in_the_past(self, steps: int) -> "Feature":
        """What it was so many steps before, which is a number of its own, or an angle."""
        turned = {} if self.is_angle else {"kind": "scalar", "frame": ""}
        group = self.group and f"{self.group}.{steps}"
        return self.replace(name=f"{self.name}.{steps}", group=group, **turned)

    @property
    def is_angle(self) -> bool:
        """Whether it is an angle."""
        return self.kind == "angle"

    @property
    def is_full_turn(self) -> bool:
        """Whether it jumps from one end of its range to the other, a full turn apart."""
        if not self.is_angle or not self.bounded or self.low is None or self.high is None:
            return False
        return math.isclose(self.high - self.low, 2 * math.pi, rel_tol=0.01)


class View(Record, frozen=True):
    """What is seen of an environment's observation, see `jbrep.envs.view`.

    Args:
        features: that the environment gives, all of them.
        hidden: names of those that aren't seen.
        history: states that are seen, the current one among them.
    """

    features: Annotated[tuple[Feature, ...], Meta(min_length=1, max_length=MAX_FEATURES)]
    hidden: Annotated[tuple[Word, ...], Meta(max_length=MAX_FEATURES)] = ()
    history: Annotated[int, Meta(ge=1, le=MAX_FEATURES)] = 1

    def check(self) -> None:
        if unknown := set(self.hidden) - {each.name for each in self.features}:
            raise InputError(f"{min(unknown)} is hidden, which is none of its features")
        if not self.places:
            raise InputError("all features are hidden: leave some to see")

    @property
    def suffix(self) -> str:
        """What the name of the task ends with."""
        without = f".without-{len(self.hidden)}" if self.hidden else ""
        return without + (f".history-{self.history}" if self.history > 1 else "")

    @property
    def places(self) -> list[int]:
        """Where the features that are seen stand among all."""
        return [i for i, each in enumerate(self.features) if each.name not in self.hidden]

    def seen(self, low: Sequence[float], high: Sequence[float]) -> tuple[Feature, ...]:
        """Features of the observation, given the bounds of actions, (k,) each."""
        now = list[Feature]()
        for _, part in groupby(self.features, key=lambda each: each.group):
            whole = [*part]
            left = [each for each in whole if each.name not in self.hidden]
            counts = SPATIAL.get(whole[0].kind)  # of a vector, all may be left, or x and y
            is_broken = counts and (len(left) not in counts or left != whole[: len(left)])
            now += [each.replace(kind="scalar", frame="") if is_broken else each for each in left]
        action = "action" if len(low) == 1 else "action_{}"
        taken = [
            Feature(name=action.format(i), low=a, high=b, bounded=True, group="action")
            for i, (a, b) in enumerate(zip(low, high, strict=True))
        ]
        lags = range(1, self.history)
        past = [each.in_the_past(lag) for part in (now, taken) for lag in lags for each in part]
        return (*now, *past)


class Task(Record, frozen=True):
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
        files: SHA-256 of the robot's own files: those that its arguments name, and the one that
            defines its class, by the names of arguments and module; packages have versions instead.
        offsets: of features by name, which are subtracted from what the environment gives, so that
            32 bits hold it: everywhere a feature is what is left.
        action_names: of an action's numbers, where they have names.
        missing: what becomes of readings that aren't finite: skip ends an episode before one,
            hold:3 has the last one instead, for at most 3 steps. Otherwise they are errors.
        view: what of the environment's observation is seen, if it isn't the current one, whole.
        domain: from which each episode draws what differs, if anything does.
    """

    id: Id
    name: Id
    features: Annotated[tuple[Feature, ...], Meta(min_length=1, max_length=MAX_FEATURES)]
    action_low: _Bounds
    action_high: _Bounds
    max_episode_steps: EpisodeSteps
    arguments: Mapping[str, Any] = {}
    timestep: _Positive | None = None
    reward_low: Finite | None = None
    reward_high: Finite | None = None
    solved_return: Finite | None = None
    terminates: bool | None = None
    reproducible: bool = True
    seed_bits: SeedBits = WIDE_SEEDS
    draws: Annotated[int, Meta(ge=0, lt=1 << 32)] | None = None
    state: _Arrays = {}
    constants: _Arrays = {}
    files: Mapping[_Part, Sha256] | UnsetType = UNSET  # left out of JSON where there are none
    offsets: Mapping[Word, Finite] | UnsetType = UNSET
    action_names: Annotated[tuple[Word, ...], Meta(max_length=_MAX_ACTIONS)] | UnsetType = UNSET
    missing: Missing | UnsetType = UNSET
    view: View | UnsetType = UNSET
    domain: Domain | UnsetType = UNSET

    def check(self) -> None:
        try:
            json.dumps(self.arguments, allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise InputError("its arguments must be plain JSON, all numbers finite") from None
        if self.view and self.features != self.view.seen(self.action_low, self.action_high):
            raise InputError("its features must be those that its view shows")
        if len(set(self.feature_names)) < self.size:
            raise InputError("its features must have different names")
        _check_groups(self.features)
        if self.state.keys() & self.constants.keys():
            raise InputError("the arrays that move and those that don't must have different names")
        _check_range("a reward", self.reward_low, self.reward_high)
        if len(self.action_low) != len(self.action_high):
            raise InputError("its actions must have as many lower bounds as upper ones")
        if not len(set(self.named_actions)) == len(self.named_actions) == self.action_size:
            raise InputError("its actions must have different names, one for each number")
        if not all(map(float.__le__, self.action_low, self.action_high)):
            raise InputError("each lower bound of its actions must be at most the upper one")
        if self.domain and len(self.domain.spread) not in (0, self.whole.size):
            raise InputError("the spread of its domain must be that of all its features")
        if unknown := set(self.offsets or ()) - set(self.whole.feature_names):
            raise InputError(f"offsets has {min(unknown)}, which is none of its features")

    def __str__(self) -> str:
        from jbrep.envs.card import card

        return card(self)

    @property
    def whole(self) -> "Task":
        """The task with all that its environment gives, now."""
        return self.replace(features=self.view.features, view=UNSET) if self.view else self

    @property
    def undisturbed(self) -> "Task":
        """The task of the robot as it is, without a domain."""
        return self.replace(domain=UNSET)

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

    @property
    def named_actions(self) -> tuple[str, ...]:
        """Names of an action's numbers, (k,): action_0 and so on where they have none."""
        return self.action_names or tuple(f"action_{i}" for i in range(self.action_size))

    @property
    def known_timestep(self) -> float:
        """From one step to the next [s]."""
        if self.timestep is None:
            raise InputError(
                f"the time step of {self.name} is not known: give it as timestep in a file of "
                "--features, of data when they are imported or collected"
            )
        return self.timestep

    @property
    def rest(self) -> Array:
        """The action of 0, or the nearest to it, (k,)."""
        return np.clip(0.0, self.action_low, self.action_high)

    @cached_property
    def feature_names(self) -> tuple[str, ...]:
        """Names of all features, in order."""
        return tuple(feature.name for feature in self.features)

    @cached_property
    def offset(self) -> Array:
        """What is subtracted from each number that the environment gives, (d,)."""
        offsets = self.offsets or {}
        return np.array([offsets.get(name, 0.0) for name in self.feature_names])

    @property
    def given_arguments(self) -> list[str]:
        """The arguments of its environment, each as `--env` takes it: body=7."""
        return [f"{name}={_as_text(value)}" for name, value in self.arguments.items()]

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
    def _centre_and_half_width(self) -> tuple[Array, Array]:
        low, high = np.array([_usual_range(feature) for feature in self.features]).T
        return (high + low) / 2, (high - low) / 2

    def scale(self, observation: Array) -> Array:
        """Scale to about [-1, 1] by the usual ranges, (..., d); features without one stay."""
        centre, half_width = self._centre_and_half_width
        return (observation - centre) / half_width

    def unscale(self, scaled: Array) -> Array:
        """The inverse of `scale`."""
        centre, half_width = self._centre_and_half_width
        return scaled * half_width + centre

    @cached_property
    def _action_bounds(self) -> tuple[Array, Array]:
        return np.array(self.action_low), np.array(self.action_high)

    def unscale_action(self, scaled: NDArray[np.floating]) -> Array:
        """Actions (..., k) from those that are scaled to [-1, 1]; whatever is beyond is clipped."""
        low, high = self._action_bounds
        action = np.minimum(np.maximum(scaled, -1), 1) * ((high - low) / 2) + (high + low) / 2
        return np.minimum(np.maximum(action, low), high)  # where they round to beyond

    def split(self, observation: NDArray[_Float]) -> dict[str, NDArray[_Float]]:
        """Split flat observations (..., d) by group; the parts are views."""
        return {name: observation[..., place] for name, place in self.groups.items()}


def _check_range(name: str, low: float | None, high: float | None) -> None:
    if low is not None and high is not None and low > high:
        raise InputError(f"the range of {name} is from {low:g} to {high:g}: swap them")


def _check_groups(features: Sequence[Feature]) -> None:
    """Make sure that groups stand together, and that vectors and the like are groups alone."""
    seen = set[str]()
    for name, part in groupby(features, key=lambda each: each.group or each.name):
        group = [*part]
        if name in seen:
            raise InputError(
                f"features of the group {name!r} must stand side by side: give those that don't "
                "belong to it a group of their own"
            )
        seen.add(name)
        kinds = {(each.kind, each.frame) for each in group}
        kind = next((kind for kind, _ in sorted(kinds) if kind in SPATIAL), None)
        if kind and len(kinds) > 1:
            raise InputError(
                f"{name} has features beside those of its {kind}: give them another group"
            )
        if kind and len(group) not in SPATIAL[kind]:
            counts = " or ".join(map(str, SPATIAL[kind]))
            raise InputError(f"{name} is a {kind} of {len(group)} numbers: it must have {counts}")


def _usual_range(feature: Feature) -> tuple[float, float]:
    low, high = feature.low, feature.high
    return (low, high) if low is not None and high is not None and low < high else (-1.0, 1.0)


def _as_text(value: Any) -> str:
    """JSON, or a text as it is where it can't be taken for JSON."""
    if isinstance(value, str) and value.isprintable():
        try:
            json.loads(value)
        except (ValueError, RecursionError):
            return value
    return json.dumps(value)


def most_held(missing: str) -> int:
    """For how many steps the last reading stands for missing ones, by `Task.missing`."""
    kind, _, steps = missing.partition(":")
    return int(steps) if kind == "hold" else 0


def check_same(expected: Task, actual: Task, what: str) -> None:
    """Make sure that what was made for the actual task has the observations of the expected one.

    Another body of the same robot will do.
    """
    if actual.id != expected.id:
        raise InputError(
            f"{what} was made for {actual.name}, not for {expected.name}: use one made for "
            f"{expected.name}"
        )
    if actual.feature_names != expected.feature_names:
        others = set(actual.feature_names) ^ set(expected.feature_names)
        such = f", such as {min(others)}" if others else ""
        raise InputError(
            f"{what} was made for other features of {actual.name}{such}: give the same `hide`, "
            "`history` and `features`"
        )
    if (actual.offsets or {}) != (expected.offsets or {}):
        raise InputError(
            f"{what} was made for features of {actual.name} with other offsets: give those in "
            "`features`"
        )
