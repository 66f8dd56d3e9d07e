"""Which columns of a frame are what to a data set: by a layout, or else by their names."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from jbrep.dataset.formats.frame import ALIASES, About, Frame, check_names, own_names, width
from jbrep.dataset.layout import Layout
from jbrep.envs.names import is_code
from jbrep.envs.task import MAX_FEATURES, Feature
from jbrep.errors import InputError, listed, matching
from jbrep.text import words

WIDE = ("observation", "action", "next_observation")  # with many numbers a row
DEGREES = ("deg", "°", "degrees", "degree")
RADIANS = ("", "rad")
MOST_RADIANS = 2 * math.pi + 0.01  # of an angle whose unit nobody says
_TURNS = (2 * math.pi, 360.0)
_IN_DEGREES = re.compile(r"[_. ]?deg(rees?)?$", re.IGNORECASE)
_MICRO = dict.fromkeys(("us", "\u00b5s", "\u03bcs"), 1e-6)  # the letter mu, too
SECONDS = {"s": 1.0, "ms": 1e-3, **_MICRO, "ns": 1e-9, "min": 60.0}  # by unit
_ACTION = re.compile(r"actions?(_\d+)?")
_NOT_FEATURES = re.compile(r"__index_level_\d+__|seed")  # pandas writes the former


class Leaf(NamedTuple):
    """A number of each row: a column, or a part of a column of lists."""

    name: str
    short: str  # the name for a feature, unless two are the same
    column: str
    place: int | None  # in a list
    kind: pa.DataType
    unit: str
    subtracted: float  # already
    feature: Feature | None
    is_angle: bool = False

    @property
    def turns_at(self) -> float | None:
        """Where its turn begins, if it is an angle that jumps to the other end there."""
        if self.is_angle:
            return -math.pi
        return self.feature.low if self.feature and self.feature.is_full_turn else None


Roles = Mapping[str, list[Leaf]]  # by the keys of ALIASES, and time


def roles_of(frame: Frame, layout: Layout) -> Roles:
    """The role of each column."""
    name, names = frame.name, frame.schema.names
    if twice := [each for each, n in Counter(names).items() if n > 1]:
        raise InputError(f"{name} has two columns {twice[0]!r}: rename one")
    leaves = [leaf for each in frame.schema for leaf in _leaves(frame, each)]
    for column, unit in layout.units.items():
        matched = {*_matching(frame, leaves, (column,))}
        leaves = [each._replace(unit=unit) if each in matched else each for each in leaves]
    by_alias = own_names(name, [*names, *frame.unusable])
    patterns = {role: (column,) for role, column in by_alias.items()} | _patterns(layout)
    for role in ["step"] * bool(layout.time) + ["reward"] * is_code(layout.reward):
        patterns.pop(role, None)  # times say more than step numbers
    roles = {role: _matching(frame, leaves, columns) for role, columns in patterns.items()}
    roles.setdefault("action", [each for each in leaves if _ACTION.fullmatch(each.column)])
    used = {*by_alias.values()} | {each.name for some in roles.values() for each in some}
    unused = [each for each in leaves if not {each.name, each.column} & used]
    unused = [each for each in unused if not _NOT_FEATURES.fullmatch(each.column)]
    if "observation" not in roles:
        own_features = frame.task and _matching(frame, leaves, frame.task.feature_names)
        roles["observation"] = own_features or unused
    observed = roles["observation"]
    angles = {*_matching(frame, observed, layout.angles, "observation")}
    roles["observation"] = [each._replace(is_angle=each in angles) for each in observed]
    if layout.observations:
        roles["next_observation"] = _after(frame, leaves, observed)
    roles = {role: some for role, some in roles.items() if some}
    _check_apart(name, roles)
    check_names(name, [*roles, *(["step"] if layout.time or layout.length else [])], names)
    for role, some in roles.items():
        if len(some) > (MAX_FEATURES if role in WIDE else 1):
            raise InputError(f"{name} has {len(some)} numbers of the {role} in a row: too many")
    for each in [] if layout.actions else roles["action"]:
        if not pa.types.is_floating(each.kind):
            raise InputError(
                f"{name} has {each.kind} in the column {each.column!r}: actions must be "
                "continuous; if it is, name the actions, or give them as floats"
            )
    return roles


def _leaves(frame: Frame, column: pa.Field) -> Iterator[Leaf]:
    size, kind, about = width(column.type), column.type, frame.about.get(column.name, About())
    places: list[int | None] = [None] if size is None else [*range(size)]
    for what, said in about._asdict().items():
        if said and len(said) != len(places):
            raise InputError(
                f"{frame.name} has {what} of {len(said)} numbers of {column.name!r}: they must be "
                f"of {len(places)}"
            )
    for i, place in enumerate(places):
        feature = about.features[i] if about.features else None
        own = about.names[i] if about.names else feature.name if feature else ""
        yield Leaf(
            column.name if place is None else f"{column.name}.{own or place}",
            own or (column.name if place is None else f"{column.name}_{place}"),
            column.name,
            place,
            kind if place is None else kind.value_type,
            about.units[i] if about.units else feature.unit if feature else "",
            about.offsets[i] if about.offsets else 0.0,
            feature,
        )


def _patterns(layout: Layout) -> dict[str, tuple[str, ...]]:
    once = {role: getattr(layout, role) for role in ("time", "episode", "terminated", "reward")}
    patterns = {role: (name,) for role, name in once.items() if name}
    wide = {"action": layout.actions, "observation": layout.observations}
    return patterns | {role: names for role, names in wide.items() if names}


def _matching(
    frame: Frame, leaves: list[Leaf], names: tuple[str, ...], what: str = "column"
) -> list[Leaf]:
    """Those of such names or patterns, in the order of the names and each once."""
    for name in names:
        if name in frame.unusable:
            raise InputError(f"{frame.name}: {name} can't be used: it is {frame.unusable[name]}")
    names_of, columns = [each.name for each in leaves], [each.column for each in leaves]
    return [leaves[i] for i in matching(names, names_of, columns, f"{frame.name} has no {what}")]


def _after(frame: Frame, leaves: list[Leaf], observed: list[Leaf]) -> list[Leaf]:
    """The columns of the same after the action; none if one is missing."""
    after = {**{name: f"next_{name}" for name in ALIASES["observation"]}, **frame.after}
    places = {(each.column, each.place): each for each in leaves}
    found = [places.get((after.get(each.column, ""), each.place)) for each in observed]
    return [each for each in found if each] if all(found) else []


def is_of_task(frame: Frame, roles: Roles) -> bool:
    """Whether observations and actions are those of the frame's task, in its order.

    Those that are said to be angles, or in other units, are others.
    """
    if not frame.task or any(each.is_angle for each in roles["observation"]):
        return False
    observed = [(each.short, each.unit) for each in roles["observation"]]
    names = frame.schema.names
    actions = [(names.index(each.column), each.place or 0) for each in roles["action"]]
    known = [(each.name, each.unit) for each in frame.task.features]
    return observed == known and actions == sorted(actions)


def features_of(name: str, leaves: list[Leaf]) -> tuple[Feature, ...]:
    """The features by the names and units of their columns; name is the frame's."""
    features, pi = list[Feature](), math.pi
    for each, word in zip(leaves, _words(leaves), strict=True):
        if not each.is_angle:
            known = each.feature or Feature(name=word)
            features.append(known.replace(name=word, unit=each.unit[:40]))
        elif each.unit in (*RADIANS, *DEGREES):
            if _IN_DEGREES.search(each.short):
                check_radians(name, each)
                word = _IN_DEGREES.sub("", word) or word  # it is in radians now
            angle = Feature(name=word, unit="rad", low=-pi, high=pi, bounded=True, kind="angle")
            features.append(angle)
        else:
            raise InputError(
                f"{name} has the angle {each.name!r} in {each.unit!r}: give rad or deg"
            )
    return tuple(features)


def action_names_of(leaves: list[Leaf]) -> tuple[str, ...] | UnsetType:
    """Names of actions after their columns, unless those only number them."""
    is_numbered = all(_ACTION.fullmatch(each.short) for each in leaves)
    return UNSET if is_numbered else _words(leaves)


def _words(leaves: list[Leaf]) -> tuple[str, ...]:
    shorts = Counter(each.short for each in leaves)
    return (*words(each.short if shorts[each.short] == 1 else each.name for each in leaves),)


def check_radians(name: str, leaf: Leaf) -> None:
    """Refuse an angle that is beyond a turn, or called degrees, unless its unit is said."""
    if leaf.is_angle and leaf.unit not in (*DEGREES, "rad"):
        raise InputError(
            f"{name} has the angle {leaf.name!r} without a unit, and it looks like degrees: give "
            f"--units {leaf.name}=deg, or {leaf.name}=rad"
        )


class Turns:
    """Finds numbers that jump by a full turn, as angles do."""

    def __init__(self) -> None:
        self._low, self._high = np.array(np.inf), np.array(-np.inf)
        self._jump = np.array(0.0)

    def see(self, values: NDArray[np.float64]) -> None:
        """Look at consecutive rows, (n, d), with NaN where nothing was read."""
        read = [column[np.isfinite(column)] for column in values.T]
        self._jump = np.fmax(self._jump, [np.abs(np.diff(each)).max(initial=0) for each in read])
        self._low = np.fmin(self._low, [each.min(initial=np.inf) for each in read])
        self._high = np.fmax(self._high, [each.max(initial=-np.inf) for each in read])

    def found(self) -> list[float]:
        """The turn of each number, (d,); 0 where there is none."""
        width, jump = np.atleast_1d(self._high - self._low), np.atleast_1d(self._jump)
        turns = np.zeros(len(width))
        for turn in _TURNS:
            turns[(width > 0.9 * turn) & (width <= 1.001 * turn) & (jump > 0.9 * turn)] = turn
        return turns.tolist()


def _check_apart(name: str, roles: Roles) -> None:
    """Refuse actions in the observation, from which they would be read when a policy is cloned."""
    acted = {(each.column, each.place) for each in roles.get("action", ())}
    if both := [e.name for e in roles["observation"] if (e.column, e.place) in acted]:
        raise InputError(
            f"{name} has {listed(both)} in the observation and in the action, which it can't show "
            "before it is chosen: name the observations without it"
        )


def second_of(name: str, time: Leaf) -> float:
    """What brings times to seconds; name is the frame's."""
    is_stamp = pa.types.is_timestamp(time.kind) or pa.types.is_duration(time.kind)
    is_number = pa.types.is_integer(time.kind) or pa.types.is_floating(time.kind)
    if not (is_stamp or is_number or pa.types.is_decimal(time.kind)):
        raise InputError(
            f"{name} has {time.kind} in the column {time.column!r}: times must be numbers, "
            "durations, or timestamps such as 2026-03-14 11:59:58.010"
        )
    unit = "ns" if is_stamp else time.unit or "s"
    if unit not in SECONDS:
        raise InputError(
            f"{name} has times {time.name!r} in {unit!r}: choose one of {', '.join(SECONDS)}"
        )
    return SECONDS[unit]
