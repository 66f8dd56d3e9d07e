"""The formulas of coordinates, column by column: for NumPy, torch and whatever else calculates.

Each takes the library (of sin, cos, sqrt, arctan2 and where) and a list of columns, and gives
columns.
Quaternions are (w, x, y, z) and turn vectors of the body into the world.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

Columns = list[Any]
_NO_LENGTH = 1e-6  # of a length squared, below which a direction says nothing
_NOTHING = 1e-18  # beside w^2 + z^2 in single precision, unless a robot is upside down


class Formula(NamedTuple):
    """A map of some numbers to others, and the way back."""

    takes: int  # how many numbers
    gives: tuple[str, ...]  # endings of the names of those that it gives
    forward: Callable[[Any, Columns, float], Columns]  # of library, columns and soft
    solves: int = 0  # how many of the numbers that it takes, from the first on, come back
    # of the library, what `forward` gave and then the other numbers that it takes, and soft
    inverse: Callable[[Any, Columns, float], Columns] | None = None


def _same(library: Any, columns: Columns, soft: float) -> Columns:
    return columns


def _circle(library: Any, columns: Columns, soft: float) -> Columns:
    (angle,) = columns
    return [library.cos(angle), library.sin(angle)]


def _angle(library: Any, columns: Columns, soft: float) -> Columns:
    cosine, sine = columns
    return [library.arctan2(sine, cosine)]


def _tilt(library: Any, columns: Columns, soft: float) -> Columns:
    """The world's z axis in the body's frame: where up is, minus the direction of gravity."""
    w, x, y, z = columns
    return [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]


def _heading(library: Any, columns: Columns, soft: float) -> Columns:
    """Cosine and sine of the turn about the vertical, times cos^2 of half the tilt."""
    w, _, _, z = columns
    return [w * w - z * z, 2 * w * z]


def _attitude(*given: Any) -> Columns:
    return _tilt(*given) + _heading(*given)


def _quaternion(library: Any, columns: Columns, soft: float) -> Columns:
    """The unit quaternion of a tilt and a heading, w not negative."""
    up_x, up_y, up_z, cosine, sine = columns
    more = 1 + abs(up_z)  # 1 - |up_z|, which is small, would be that of the last digits
    flat = (up_x * up_x + up_y * up_y) / more
    share = library.where(up_z < 0, flat, more) / 2 + _NOTHING  # w^2 + z^2
    half = library.arctan2(sine, cosine) / 2
    root = library.sqrt(share)
    w, z = root * library.cos(half), root * library.sin(half)
    half_turn = 2 * _NOTHING  # about x, exactly upside down
    x = (z * up_x + w * up_y + half_turn) / (2 * share)
    y = (z * up_y - w * up_x) / (2 * share)
    norm = library.sqrt(w * w + x * x + y * y + z * z)
    return [w / norm, x / norm, y / norm, z / norm]


def _upright(library: Any, columns: Columns, soft: float) -> Columns:
    """The quaternion of a tilt, heading along the world's x axis."""
    nothing = columns[0] * 0
    return _quaternion(library, [*columns, nothing + 1, nothing], soft)


def _rotate(sign: int, library: Any, columns: Columns, soft: float) -> Columns:
    """A vector turned by a quaternion, or by its inverse if the sign is -1."""
    a, b, c, w, x, y, z = columns
    w = sign * w
    p, q, r = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return [a + 2 * (y * r - z * q), b + 2 * (z * p - x * r), c + 2 * (x * q - y * p)]


def _turned(library: Any, columns: Columns, soft: float) -> Columns:
    """A planar vector turned back by the angle of another one, times the other's length.

    Of two directions: cosine and sine of their difference.
    """
    x, y, cosine, sine = columns
    return [x * cosine + y * sine, y * cosine - x * sine]


def _turned_back(library: Any, columns: Columns, soft: float) -> Columns:
    x, y, cosine, sine = columns
    size = cosine * cosine + sine * sine + _NO_LENGTH
    return [(x * cosine - y * sine) / size, (y * cosine + x * sine) / size]


def _polar(library: Any, columns: Columns, soft: float) -> Columns:
    """Length and direction, without the corner that they have at 0.

    With R = sqrt(x^2 + y^2 + soft^2): R - soft, x / R, y / R.
    """
    x, y = columns
    length = library.sqrt(x * x + y * y + soft * soft)
    return [length - soft, x / length, y / length]


def _planar(library: Any, columns: Columns, soft: float) -> Columns:
    length, x, y = columns
    return [x * (length + soft), y * (length + soft)]


def _difference(library: Any, columns: Columns, soft: float) -> Columns:
    x, y, other_x, other_y = columns
    return [x - other_x, y - other_y]


def _sum(library: Any, columns: Columns, soft: float) -> Columns:
    x, y, other_x, other_y = columns
    return [x + other_x, y + other_y]


_AXES = "x", "y", "z"
_PLANE = "x", "y"
_TURN = "cos", "sin"
_UP = "up_x", "up_y", "up_z"

FORMULAS: dict[str, Formula] = {
    "same": Formula(1, ("",), _same, 1, _same),
    "circle": Formula(1, _TURN, _circle, 1, _angle),
    "tilt": Formula(4, _UP, _tilt, 4, _upright),
    "heading": Formula(4, _TURN, _heading),
    "attitude": Formula(4, (*_UP, *_TURN), _attitude, 4, _quaternion),
    "body": Formula(7, _AXES, partial(_rotate, -1), 3, partial(_rotate, 1)),
    "turned": Formula(4, _TURN, _turned, 2, _turned_back),
    "polar": Formula(2, ("length", *_TURN), _polar, 2, _planar),
    "difference": Formula(4, _PLANE, _difference, 2, _sum),
}
