"""Systems of coordinates, made from what a task says of its features."""

from collections.abc import Collection, Iterator
from functools import cached_property
from itertools import combinations
from typing import Any, Literal, get_args

from jbrep.coordinates.coordinates import Coordinates, Part
from jbrep.envs.task import SPATIAL, Feature, Task
from jbrep.errors import InputError

System = Literal["observation", "angles", "coordinates", "symmetry"]
Ingredient = Literal["angles", "attitude", "body", "distance", "phases"]
INGREDIENTS: tuple[Ingredient, ...] = get_args(Ingredient)
OBSERVATION: System = "observation"
_NEEDED = frozenset(("attitude", "body"))  # without which nothing is invariant
_SOFT = 0.01  # length at which a distance leaves its corner: this share of its usual range
_Names = tuple[str, ...]
_Features = tuple[Feature, ...]


def make_coordinates(
    task: Task, system: System, leave_out: Collection[Ingredient] = ()
) -> Coordinates | None:
    """A task's coordinates, from the kinds of its features; None for the observation itself.

    Args:
        task: says what its features are.
        system: `observation` for the features as they are; `angles` with each angle as cosine and
            sine; `coordinates` with all ingredients; `symmetry` without what shifting and turning
            the world changes.
        leave_out: of the last two: `angles` (cosine and sine), `attitude` (a quaternion as tilt and
            heading), `body` (vectors of the world in the body's frame), `distance` (length and
            direction of offsets), `phases` (differences of angles and directions that turn wholly).
    """
    if leave_out and system in (OBSERVATION, "angles"):
        raise InputError(f"nothing can be left out of {system}: give coordinates or symmetry")
    if system == OBSERVATION:
        return None
    invariant = system == "symmetry"
    if invariant and (needed := _NEEDED & set(leave_out)):
        raise InputError(f"{min(needed)} can't be left out of symmetry: nothing else is invariant")
    used = {"angles"} if system == "angles" else set(INGREDIENTS) - set(leave_out)
    made = Coordinates(task, tuple(_Maker(task, used, invariant).parts()))
    if invariant and list(made.parts) == _Maker(task, used, False).parts():
        raise InputError(
            f"{task.name} has no feature that says where its robot is in the world or how it is "
            "turned, so symmetry has nothing to leave out: use coordinates"
        )
    if not made.names:
        raise InputError(f"{system} of {task.name} leaves nothing: use coordinates")
    if made.names == task.feature_names:
        raise InputError(
            f"{system} of {task.name} would be the observation: declare kinds of its features in "
            "a file of --features, of a log's data when it is imported"
        )
    return made


class _Maker:
    """Makes the parts of a task's coordinates, of some ingredients, one kind of features at a time.

    Invariant ones leave out what shifting and turning the world changes.
    """

    def __init__(self, task: Task, used: Collection[str], invariant: bool):
        self._task, self._used, self._invariant = task, used, invariant
        self._parts: list[Part] = []
        self._directions: list[tuple[str, _Names]] = []  # that turn wholly, as cosine and sine
        self._place: _Names = ()  # x and y of the first point in the world
        self._attitude = attitude_of(task)
        self._quaternion = self._attitude if len(self._attitude) == 4 else ()

    def parts(self) -> list[Part]:
        """All parts, in the order of the features; phases come last."""
        makers = {
            "scalar": self._same,
            "angle": self._angle,
            "quaternion": self._tilt,
            "vector": self._vector,
            "offset": self._offset,
            "point": self._point,
        }
        for _, unit in units(self._task):
            makers[unit[0].kind](unit)
        if "phases" in self._used:
            for (name, turn), (other, other_turn) in combinations(self._directions, 2):
                self._add(f"{name}-{other}", "turned", (*turn, *other_turn))
        return self._parts

    def _add(
        self, name: str, formula: Any, of: _Names, shown: bool = True, soft: float = 0
    ) -> _Names:
        part = Part(name=name, formula=formula, of=of, shown=shown, soft=soft)
        taken = {*self._task.feature_names, *(name for each in self._parts for name in each.gives)}
        while formula != "same" and {*part.gives} & taken:
            part = part.replace(name=f"{part.name}.{formula}")
        self._parts.append(part)
        return part.gives

    @cached_property
    def _heading(self) -> _Names:
        """Cosine and sine of the body's heading in the world, hidden; none if it has none."""
        if not self._attitude:
            return ()
        formula = "heading" if self._quaternion else "circle"
        return self._add(f"{self._attitude[0]}.heading", formula, self._attitude, False)

    def _same(self, unit: _Features) -> _Names:
        return sum((self._add(each.name, "same", (each.name,)) for each in unit), ())

    def _angle(self, unit: _Features) -> None:
        angle, name = unit[0], unit[0].name
        if angle.frame == "world" and self._invariant:
            if self._attitude != (name,):  # else it is the heading itself
                turn = self._add(f"{name}.world", "circle", (name,), False)
                self._add(name, "turned", (*turn, *self._heading))
        elif "angles" not in self._used:
            self._same(unit)
        else:
            turn = self._add(name, "circle", (name,))
            if angle.is_full_turn and angle.frame != "world":
                self._directions.append((name, turn))

    def _tilt(self, unit: _Features) -> None:
        if "attitude" in self._used and tuple(each.name for each in unit) == self._quaternion:
            self._add(_word(unit), "tilt" if self._invariant else "attitude", self._quaternion)
        elif self._invariant:
            raise InputError(
                f"{self._task.name} has several attitudes, {_word(unit)} among them: symmetry is "
                "that of one body"
            )
        else:
            self._same(unit)

    def _vector(self, unit: _Features) -> _Names:
        """A vector in the body's frame, if it is one of the world; the names of its numbers."""
        if unit[0].frame != "world" or "body" not in self._used:
            return self._same(unit)
        names = tuple(each.name for each in unit)
        if len(names) == 3 and self._quaternion:
            return self._add(_word(unit), "body", (*names, *self._quaternion))
        if self._heading:
            return self._add(_word(unit), "turned", (*names[:2], *self._heading)) + self._same(
                unit[2:]
            )
        if self._invariant:
            raise self._unturned(unit)
        return self._same(unit)

    def _unturned(self, unit: _Features) -> InputError:
        return InputError(
            f"{self._task.name} has {_word(unit)} in the world, but no feature says how its "
            "body is turned: symmetry needs a quaternion, or an angle in the world"
        )

    def _offset(self, unit: _Features) -> None:
        self._polar(_word(unit), self._vector(unit)[:2], unit)

    def _polar(self, name: str, plane: _Names, like: _Features) -> None:
        if "distance" in self._used:
            ends = [abs(end or 0.0) for each in like[:2] for end in (each.low, each.high)]
            soft = _SOFT * (max(ends) or 1.0)
            _, *turn = self._add(f"{name}_at", "polar", plane, soft=soft)
            self._directions.append((f"{name}_at", tuple(turn)))

    def _point(self, unit: _Features) -> None:
        names = tuple(each.name for each in unit)
        if not self._invariant:
            self._same(unit)
            return
        self._same(unit[2:])  # the height
        if not self._place:
            self._place = names[:2]
            return
        apart = self._add(f"{_word(unit)}.apart", "difference", (*names[:2], *self._place), False)
        if not self._heading:
            raise self._unturned(unit)
        plane = self._add(_word(unit), "turned", (*apart, *self._heading))
        self._polar(_word(unit), plane, unit)


def units(task: Task) -> Iterator[tuple[slice, _Features]]:
    """The features that belong together, with their places: a vector's, or one by itself."""
    for place in task.groups.values():
        if task.features[place.start].kind in SPATIAL:
            yield place, task.features[place]
        else:
            yield from (
                (slice(i, i + 1), (task.features[i],)) for i in range(place.start, place.stop)
            )


def attitude_of(task: Task) -> tuple[str, ...]:
    """The features that say how a body is turned: a quaternion, or an angle in the world."""
    every = [unit for _, unit in units(task)]
    turned = [unit for unit in every if unit[0].kind == "quaternion"] or [
        unit for unit in every if unit[0].kind == "angle" and unit[0].frame == "world"
    ]
    return tuple(each.name for each in turned[0]) if turned else ()


def _word(unit: _Features) -> str:
    return unit[0].group or unit[0].name
