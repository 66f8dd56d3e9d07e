"""What single features show: jumps, two signs, degrees, bounds, copies, scales."""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jbrep.checking.findings import Finding, several
from jbrep.checking.seen import RANDOM, Seen
from jbrep.envs.task import Array

TURNS = (-np.pi, 2 * np.pi), (0.0, 2 * np.pi), (-180.0, 360.0), (0.0, 360.0)  # least value, turn
_ROOM = 0.02  # of a turn, at its ends
_WIDE = 0.8  # of a range: a jump from near one end to near the other
_CALM = 0.3  # of a turn: what nearly all other steps stay below
_FEWEST_JUMPS, _FEWEST_VALUES = 3, 20  # of what has no usual range
_FLAT = 1e-9  # of a feature's magnitude: rounding
_ROUNDING = 1e-5  # of a feature's deviation: what a copy may differ by
_AT_BOUND = 0.1  # share of rows that are exactly at the least or greatest value
_APART = 100.0  # times, from the scale of most features
_UNIT = 1e-3  # by which the length of a quaternion may differ from 1
_DEGREES = re.compile(r"(^|[_.\W])(deg|degs|degrees?)([_.\W]|$)", re.IGNORECASE)
_ANGLE = re.compile(
    r"(^|[_.\W])(yaw|pitch|roll|heading|bearing|azimuth|angles?|theta|phi|psi|tilt)([_.\W\d]|$)",
    re.IGNORECASE,
)


class Turn(NamedTuple):
    """A range from whose end a feature jumps to the other."""

    low: float
    size: float
    jumps: int
    moves: float  # by which it moves in a step otherwise, at most

    @property
    def is_radian(self) -> bool:
        """Whether the range is a full turn in rad."""
        return (self.low, self.size) in TURNS[:2]

    @property
    def is_degree(self) -> bool:
        """Whether it is one in degrees."""
        return (self.low, self.size) in TURNS[2:]


class Shapes(NamedTuple):
    """What was found of the features, for what else is asked."""

    turns: dict[int, Turn]  # of those that jump by a full turn, by their places
    quaternions: list[int]  # the first place of each that changes its sign
    idle: list[int]  # places of features that are constant, or copies of an earlier one


def shapes(seen: Seen) -> tuple[Shapes, list[Finding]]:
    """What the features are like, and what of that is to be changed."""
    before, after, task = seen.before, seen.after, seen.task
    names = task.feature_names
    turns = {
        i: turn
        for i in range(task.size)
        if (turn := turn_of(before[:, i], after[:, i], task.features[i].is_full_turn))
    }
    flips = dict(_flips(before, after))
    is_flat = np.ptp(before, axis=0) <= _FLAT * np.abs(before).max(axis=0)
    flat = np.flatnonzero(is_flat).tolist()
    copies = _copies(before, {*flat, *turns})
    found = [_wraps(seen, i, turn) for i, turn in turns.items()]
    found += [_signs(seen, first, count) for first, count in flips.items()]
    for i in flat:
        why = f"{before[0, i]:.4g} in all {len(before):,} rows"
        numbers = {"value": float(before[0, i])}
        found.append(Finding("constant", (names[i],), why, _hide([names[i]]), numbers))
    for i, (other, slope, offset) in copies.items():
        why = f"{slope:.4g} x {names[other]} {offset:+.4g}"
        fix = _hide([names[i]])
        numbers = {"slope": slope, "offset": offset}
        found.append(Finding("copy", (names[i], names[other]), why, fix, numbers))
    idle = [*flat, *copies]
    others = [i for i in range(task.size) if i not in idle and i not in turns]
    found += [each for i in others if (each := _degrees(seen, i))]
    found += [each for i in others if (each := _saturated(seen, i))]
    found += _scales(seen, others)
    return Shapes(turns, [*flips], idle), found


def _hide(names: Sequence[str]) -> str:
    return " ".join(f"--hide {name}" for name in names)


def turn_of(before: Array, after: Array, is_known: bool = False) -> Turn | None:
    """The range that a feature (n,) jumps through while it moves little otherwise, if it does."""
    both = np.concatenate((before, after))
    low, high = float(both.min()), float(both.max())
    size = np.abs(after - before)
    own = (low, high - low)
    for start, turn in (*TURNS, own):
        is_usual = (start, turn) != own
        if not turn or low < start - _ROOM * turn or high > start + (1 + _ROOM) * turn:
            continue
        jumped = size > _WIDE * turn if not is_known else size > turn / 2
        if not jumped.any() or (jumped.sum() < _FEWEST_JUMPS and not is_usual):
            continue
        usual, left = size[~jumped], np.abs(size[jumped] - turn)
        moves = float(usual.max(initial=0))
        if not is_usual and not _is_smooth(both, low, turn):
            continue
        calm = np.quantile(usual, 0.99) <= _CALM * turn if len(usual) else False
        if is_known or (calm and left.max() <= max(1.5 * moves, _ROOM * turn)):
            return Turn(start, turn, int(jumped.sum()), moves)
    return None


def _is_smooth(values: Array, low: float, size: float) -> bool:
    """Whether values are all over their range, not at two or three levels."""
    shares, _ = np.histogram(values, 8, (low, low + size))
    return len(np.unique(values)) >= _FEWEST_VALUES and shares.min() > 0.01 * len(values)


def _wraps(seen: Seen, i: int, turn: Turn) -> Finding:
    feature, ends = seen.task.features[i], (turn.low, turn.low + turn.size)
    times = f"{turn.jumps:,} times" if turn.jumps > 1 else "once"
    why = (
        f"jumps between {ends[0]:.4g} and {ends[1]:.4g} {times} in {len(seen.before):,} steps; "
        f"otherwise it moves by at most {turn.moves:.2g}"
    )
    if feature.is_angle:
        fix = "--encoder coordinates, or symmetry: cosine and sine have no jump"
    elif turn.is_radian:
        fix = (
            f'features.toml: kind = "angle", unit = "rad", low = {ends[0]:.17g}, '
            f"high = {ends[1]:.17g}, bounded = true; then --encoder coordinates"
        )
    elif turn.is_degree:
        fix = f"in degrees: {_in_radians(feature.name)}; then it is an angle for features.toml"
    else:
        fix = "give its cosine and sine, or the angle in rad, in the environment"
    numbers = {"low": ends[0], "high": ends[1], "jumps": turn.jumps, "moves": turn.moves}
    return Finding("wraps", (feature.name,), why, fix, numbers)


def _in_radians(name: str) -> str:
    return f"give np.radians({name}) in the environment, or import with --units {name}=deg"


def _flips(before: Array, after: Array) -> Iterator[tuple[int, int]]:
    """Quaternions by their first feature, with the number of steps at which all signs change."""
    size, i = before.shape[1], 0
    while i + 4 <= size:
        place = slice(i, i + 4)
        lengths = np.linalg.norm(before[:, place], axis=1)
        along = (before[:, place] * after[:, place]).sum(axis=1)
        if np.abs(lengths - 1).max() <= _UNIT and (flipped := int((along < -0.9).sum())):
            yield i, flipped
            i += 3
        i += 1


def _signs(seen: Seen, first: int, count: int) -> Finding:
    names = seen.task.feature_names[first : first + 4]
    part = seen.before[:, first : first + 4]
    why = f"of unit length; all four change their signs in {count:,} of {len(part):,} steps"
    if seen.task.features[first].kind == "quaternion":
        fix = "--encoder coordinates, or symmetry: tilt and heading have one value each"
    elif (part**2).mean(axis=0).argmax() == 3:
        fix = "give w first, then x, y, z, in the environment; then as a quaternion"
    else:
        fix = (
            'features.toml: kind = "quaternion" and a group of their own, if in the order w, x, '
            "y, z; then --encoder coordinates"
        )
    return Finding("signs", names, why, fix, {"flips": count})


def _copies(rows: Array, without: set[int]) -> dict[int, tuple[int, float, float]]:
    """Features that are affine functions of an earlier one, with slope and offset."""
    own = [i for i in range(rows.shape[1]) if i not in without]
    if len(own) < 2:
        return {}
    centred = rows[:, own] - rows[:, own].mean(axis=0)
    deviation = centred.std(axis=0)
    correlation = (centred.T @ centred) / len(rows) / np.outer(deviation, deviation)
    same = np.sqrt(np.maximum(1 - correlation**2, 0)) < _ROUNDING
    found = dict[int, tuple[int, float, float]]()
    for j, i in enumerate(own):
        earlier = [k for k in np.flatnonzero(same[j, :j]).tolist() if own[k] not in found]
        if earlier:
            k = earlier[0]
            slope = float(correlation[j, k] * deviation[j] / deviation[k])
            offset = float(rows[:, i].mean() - slope * rows[:, own[k]].mean())
            found[i] = own[k], slope, offset
    return found


def _degrees(seen: Seen, i: int) -> Finding | None:
    feature, largest = seen.task.features[i], float(np.abs(seen.before[:, i]).max())
    named = _DEGREES.search(feature.name) or _DEGREES.search(feature.unit) or feature.unit == "°"
    angle = _ANGLE.search(feature.name) and not feature.unit and 2.1 * np.pi < largest <= 361
    if not (named or angle):
        return None
    said = f"called {feature}, and" if named else "named as an angle, but"
    why = f"{said} it goes to {largest:.4g}"
    return Finding("degrees", (feature.name,), why, _in_radians(feature.name), {"largest": largest})


def _saturated(seen: Seen, i: int) -> Finding | None:
    random = np.char.startswith(seen.policy, RANDOM)  # others push against an end all the time
    rows = seen.after[random, i]
    values, counts = np.unique(rows, return_counts=True)
    if len(values) < _FEWEST_VALUES:
        return None
    ends = {float(values[at]): counts[at] / len(rows) for at in (0, -1) if values[at]}
    worst = {end: share for end, share in ends.items() if share > _AT_BOUND}
    if not worst:
        return None
    told = " and ".join(f"{share:.0%} at {end:.4g}" for end, share in worst.items())
    name = seen.task.feature_names[i]
    fix = "widen its range in the environment or the sensor; what is beyond isn't seen"
    why = f"{told} exactly, of {len(rows):,} rows"
    return Finding("saturated", (name,), why, fix, {"shares": [*map(list, worst.items())]})


def _scales(seen: Seen, places: Sequence[int]) -> Iterator[Finding]:
    """Of features without a usual range, which nothing scales where they are seen as they are."""
    features = seen.task.features
    free = [i for i in places if features[i].low is None or features[i].high is None]
    if len(free) < 2:
        return
    deviation = dict(zip(free, seen.before[:, free].std(axis=0).tolist(), strict=True))
    usual = float(np.median([*deviation.values()]))
    apart = {i: max(each / usual, usual / each) for i, each in deviation.items()}
    if far := [i for i in free if apart[i] > _APART]:
        names, worst = tuple(features[i].name for i in far), max(far, key=apart.__getitem__)
        why = (
            f"{features[worst].name} varies by {deviation[worst]:.2g}, most others by about "
            f"{usual:.2g}"
        )
        fix = f"features.toml: low and high of {several(names)}; or --normalize"
        yield Finding("scales", names, why, fix, {"apart": apart[worst]})
