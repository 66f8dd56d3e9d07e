"""What single features show: jumps, two signs, degrees, bounds, copies, scales."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jbrep.checking.transitions import RANDOM, Transitions
from jbrep.envs.task import Array

WORST_FIRST = {  # kinds of findings
    "reward": "the reward hardly depends on the state",
    "sparse": "rewards are sparse",
    "delay": "actions act late",
    "hidden": "one observation isn't enough",
    "wraps": "wraps",
    "winds": "winds beyond a full turn",
    "signs": "a quaternion changes its sign",
    "degrees": "in degrees",
    "world": "where the robot is in the world doesn't matter",
    "saturated": "saturated",
    "scales": "scales far apart",
    "copy": "copy",
    "constant": "constant",
    "random": "not reproducible",
}
# from, by; in rad first
TURNS = ((-np.pi, 2 * np.pi), (0.0, 2 * np.pi), (-180.0, 360.0), (0.0, 360.0))
_ROOM, _WIDE, _CALM = 0.02, 0.8, 0.3  # shares of a turn: margin at its ends, jumps, other steps
_FEWEST_JUMPS, _FEWEST_VALUES = 3, 20  # of what has another range
_FLAT, _ROUNDING = 1e-9, 1e-5  # of a feature's magnitude, of the deviation of a copy
_AT_BOUND = 0.1  # share of rows that are exactly at the least or greatest value
_APART = 100.0  # times, from the scale of most features
_UNIT = 1e-3  # error of a quaternion's length
_SHOWN = 4  # names in a line
_DEGREES = re.compile(r"(^|[_.\W])(deg|degrees?|°)([_.\W]|$)", re.IGNORECASE)
_ANGLE = re.compile(
    r"(^|[_.\W])(yaw|pitch|roll|heading|bearing|angle|theta|tilt)"
    r"(?!.*(dot|rate|vel|speed|acc))([_.\W\d]|$)",
    re.IGNORECASE,
)


class Finding(NamedTuple):
    """Something to change."""

    kind: str
    features: tuple[str, ...]  # that it is about; none of all
    evidence: str
    fix: str
    numbers: Mapping[str, Any] = {}  # that the evidence tells

    @property
    def title(self) -> str:
        """What it is, and of what, in a few words."""
        about = f": {several(self.features)}" if self.features else ""
        return WORST_FIRST[self.kind] + about


class Turn(NamedTuple):
    """A range from whose end a feature jumps to the other."""

    low: float
    size: float
    jumps: int
    moves: float  # by which it moves in a step otherwise, at most


class Shapes(NamedTuple):
    """What was found of the features, for what else is asked."""

    turns: dict[int, Turn]  # of those that jump by a full turn, by their places
    quaternions: list[int]  # the first place of each that changes its sign
    idle: list[int]  # places of features that are constant, or copies of an earlier one


def several(names: Sequence[str], before: str = "", between: str = ", ") -> str:
    """Names on one line, the first of many."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return between.join(f"{before}{name}" for name in names[:_SHOWN]) + more


def shapes(seen: Transitions) -> tuple[Shapes, list[Finding]]:
    """What the features are like, and what of that is to be changed."""
    before, features = seen.before, seen.task.features
    flips = dict(_flips(before, seen.after))
    turns = {
        i: turn
        for i, each in enumerate(features)
        if not any(first <= i < first + 4 for first in flips)
        and (turn := turn_of(before[:, i], seen.after[:, i], each.is_full_turn))
    }
    flat = np.flatnonzero(np.ptp(before, axis=0) <= _FLAT * np.abs(before).max(axis=0)).tolist()
    copies = _copies(before, [i for i in range(len(features)) if i not in (*flat, *turns)])
    found = [_wraps(seen, i, turn) for i, turn in turns.items()]
    found += [_signs(seen, first, count) for first, count in flips.items()]
    if flat:
        names = tuple(features[i].name for i in flat)
        values = ", ".join(dict.fromkeys(f"{before[0, i]:.4g}" for i in flat))
        found.append(
            Finding("constant", names, f"{values} in all steps", several(names, "--hide ", " "))
        )
    for i, (other, slope) in copies.items():
        names = features[i].name, features[other].name
        why = f"equals {slope:.4g} times {names[1]} plus a constant"
        found.append(Finding("copy", names, why, several(names[:1], "--hide "), {"slope": slope}))
    idle = [*flat, *copies]
    others = [i for i in range(len(features)) if i not in (*idle, *turns)]
    alone = (_degrees, _saturated, _winds)
    found += [each for i in others for ask in alone if (each := ask(seen, i))]
    return Shapes(turns, [*flips], idle), [*found, *_scales(seen, others)]


def turn_of(before: Array, after: Array, is_known: bool = False) -> Turn | None:
    """The range that a feature (n,) jumps through while it moves little otherwise, if it does."""
    both, size = np.concatenate((before, after)), np.abs(after - before)
    low, high = float(both.min()), float(both.max())
    for start, turn in (*TURNS, (low, high - low)):
        is_usual = (start, turn) in TURNS
        if not turn or low < start - _ROOM * turn or high > start + (1 + _ROOM) * turn:
            continue
        jumped = size > (0.5 if is_known else _WIDE) * turn
        usual, left = size[~jumped], np.abs(size[jumped] - turn)
        shares, _ = np.histogram(both, 8, (low, high))
        is_smooth = len(np.unique(both)) >= _FEWEST_VALUES and shares.min() > 0.01 * len(both)
        if len(left) < (1 if is_usual else _FEWEST_JUMPS) or not (is_usual or is_smooth):
            continue
        moves = float(usual.max(initial=0))
        calm = len(usual) and np.quantile(usual, 0.99) <= _CALM * turn and moves < turn / 2
        if is_known or (calm and left.max() <= max(1.5 * moves, _ROOM * turn)):
            return Turn(start, turn, len(left), moves)
    return None


def _wraps(seen: Transitions, i: int, turn: Turn) -> Finding:
    feature, low, high = seen.task.features[i], turn.low, turn.low + turn.size
    why = (
        f"jumps between {low:.4g} and {high:.4g} in {turn.jumps:,} of {len(seen.before):,} steps; "
        f"else it moves by at most {turn.moves:.2g}"
    )
    if feature.is_angle:
        fix = "--encoder coordinates: cosine and sine have no jump"
    elif (low, turn.size) in TURNS[:2]:
        fix = (
            f'features.toml: kind = "angle", unit = "rad", low = {low:.17g}, high = {high:.17g}, '
            "bounded = true; then --encoder coordinates"
        )
    elif (low, turn.size) in TURNS:
        fix = f"in degrees: {_in_radians(feature.name)}"
    else:
        fix = "give its cosine and sine in the environment"
    return Finding("wraps", (feature.name,), why, fix, turn._asdict())


def _winds(seen: Transitions, i: int) -> Finding | None:
    feature, low, high = seen.task.features[i], seen.before[:, i].min(), seen.before[:, i].max()
    if not feature.is_angle or high - low <= 2 * np.pi * (1 + _ROOM):
        return None
    why = f"goes from {low:.3g} to {high:.3g} rad: one pose has several values"
    return Finding(
        "winds", (feature.name,), why, "--encoder coordinates: after a turn they are the same"
    )


def _in_radians(name: str) -> str:
    by_import = f"--angles {name} --units {name}=deg"
    return f"give np.radians({name}) in the environment, or import with {by_import}"


def _flips(before: Array, after: Array) -> Iterator[tuple[int, int]]:
    """Quaternions by their first feature, with the number of steps at which all signs change."""
    i = 0
    while i + 4 <= before.shape[1]:
        now, then = before[:, i : i + 4], after[:, i : i + 4]
        flipped = int(((now * then).sum(axis=1) < -0.9).sum())
        is_unit = np.abs(np.linalg.norm(now, axis=1) - 1).max() <= _UNIT
        if is_unit and flipped:
            yield i, flipped
        i += 4 if is_unit else 1


def _signs(seen: Transitions, first: int, count: int) -> Finding:
    why = f"of unit length; all four change signs in {count:,} of {len(seen.before):,} steps"
    known = seen.task.features[first].kind == "quaternion"
    say = "" if known else 'features.toml: kind = "quaternion", if in the order w, x, y, z; then '
    names = seen.task.feature_names[first : first + 4]
    return Finding("signs", names, why, f"{say}--encoder coordinates", {"flips": count})


def _copies(rows: Array, own: Sequence[int]) -> dict[int, tuple[int, float]]:
    """Features, of some, that are affine functions of an earlier one, with that and the slope."""
    centred = rows[:, own] - rows[:, own].mean(axis=0)
    deviation = centred.std(axis=0)
    correlation = (centred.T @ centred) / len(rows) / np.outer(deviation, deviation)
    same = np.sqrt(np.maximum(1 - correlation**2, 0)) < _ROUNDING
    found = dict[int, tuple[int, float]]()
    for j, i in enumerate(own):
        earlier = [k for k in np.flatnonzero(same[j, :j]).tolist() if own[k] not in found]
        if earlier:
            k = earlier[0]
            found[i] = own[k], float(correlation[j, k] * deviation[j] / deviation[k])
    return found


def _degrees(seen: Transitions, i: int) -> Finding | None:
    feature, largest = seen.task.features[i], float(np.abs(seen.before[:, i]).max())
    is_named = _DEGREES.search(feature.name) or _DEGREES.search(feature.unit)
    is_angle = _ANGLE.search(feature.name) and not feature.unit and 2.1 * np.pi < largest <= 361
    if not (is_named or is_angle):
        return None
    why = f"its name or unit says so, and it goes to {largest:.4g}"
    return Finding("degrees", (feature.name,), why, _in_radians(feature.name), {"most": largest})


def _saturated(seen: Transitions, i: int) -> Finding | None:
    rows = seen.after[np.char.startswith(seen.policy, RANDOM), i]  # others push all the time
    values, counts = np.unique(rows, return_counts=True)
    ends = {float(values[at]): counts[at] / len(rows) for at in (0, -1) if values[at]}
    worst = {end: float(share) for end, share in ends.items() if share > _AT_BOUND}
    if not worst or len(values) < _FEWEST_VALUES:
        return None
    why = " and ".join(f"{share:.0%} at {end:.4g}" for end, share in worst.items()) + " exactly"
    fix = "widen its range in the environment or the sensor; what is beyond isn't seen"
    return Finding(
        "saturated", (seen.task.feature_names[i],), why, fix, {"shares": [*worst.items()]}
    )


def _scales(seen: Transitions, places: Sequence[int]) -> Iterator[Finding]:
    """Of features without a usual range, which nothing scales where they are seen as they are."""
    features = [seen.task.features[i] for i in places]
    free = [at for at, each in enumerate(features) if each.low is None or each.high is None]
    deviation = seen.before[:, [places[at] for at in free]].std(axis=0)
    usual = float(np.median(deviation)) if free else 1.0
    apart = np.maximum(deviation / usual, usual / deviation)
    if far := [k for k in range(len(free)) if apart[k] > _APART]:
        names, worst = tuple(features[free[k]].name for k in far), far[int(apart[far].argmax())]
        why = (
            f"{features[free[worst]].name} varies by {deviation[worst]:.2g}, most others by about "
            f"{usual:.2g}"
        )
        fix = f"features.toml: low and high of {several(names)}; or --normalize"
        yield Finding("scales", names, why, fix, {"apart": float(apart[worst])})
