"""Coordinates as data: which formulas, of which features, in which order."""

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property
from types import SimpleNamespace
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from jbrep.coordinates.formulas import FORMULAS, Columns, Formula
from jbrep.envs.task import Feature, Task, Word
from jbrep.errors import InputError
from jbrep.records.record import Record

_FULL_TURN = 2.02 * math.pi  # and what rounding adds
_PLAIN = SimpleNamespace(sin=math.sin, cos=math.cos, sqrt=math.sqrt, arctan2=math.atan2)
_Soft = Annotated[float, Meta(ge=0, le=1e12)]


class Part(Record, frozen=True, array_like=True):
    """A formula, applied to some features or to what earlier parts gave."""

    name: Word  # of what it gives, with an ending for each number
    formula: Literal[
        "same", "circle", "tilt", "heading", "attitude", "body", "turned", "polar", "difference"
    ]
    of: tuple[Word, ...]
    shown: bool = True  # whether what it gives is among the coordinates
    soft: _Soft = 0.0  # length at which a polar coordinate leaves its corner

    def check(self) -> None:
        if len(self.of) != self._formula.takes:
            raise InputError(
                f"{self.name}, {self.formula}, takes {self._formula.takes} numbers, but is given "
                f"{len(self.of)}"
            )
        if self.formula == "polar" and not self.soft:
            raise InputError(f"the soft length of {self.name} is 0: it must be positive")

    @property
    def _formula(self) -> Formula:
        return FORMULAS[self.formula]

    @property
    def gives(self) -> tuple[str, ...]:
        """Names of the numbers that it gives."""
        return tuple(f"{self.name}.{end}" if end else self.name for end in self._formula.gives)


class _Step(NamedTuple):
    """A part's formula, or its inverse, which gives some of the numbers that the part is of."""

    part: Part
    is_inverse: bool

    @property
    def takes(self) -> tuple[str, ...]:
        """Names of the numbers that are needed."""
        part, formula = self.part, FORMULAS[self.part.formula]
        return part.gives + part.of[formula.solves :] if self.is_inverse else part.of

    @property
    def gives(self) -> tuple[str, ...]:
        """Names of the numbers that follow."""
        part, formula = self.part, FORMULAS[self.part.formula]
        return part.of[: formula.solves] if self.is_inverse else part.gives

    def calculate(self, library: Any, known: dict[str, Any]) -> None:
        """Add columns to those that are known, by name."""
        formula = FORMULAS[self.part.formula]
        function = formula.inverse if self.is_inverse else formula.forward
        assert function is not None  # else it would give nothing
        made = function(library, [known[name] for name in self.takes], self.part.soft)
        for name, column in zip(self.gives, made, strict=True):
            known.setdefault(name, column)


class Coordinates:
    """A fixed map from a task's observations to other numbers, and the way back if there is one.

    Observations and coordinates are NumPy arrays or torch tensors, with the numbers along the last
    axis. None of the formulas jumps; of a body that stands on its head the heading is lost.

    Attributes:
        task: whose observations they are calculated from.
        parts: in order; each takes features, or what earlier parts give.
        names: of all coordinates, in order.
        sources: the part that each coordinate is of, by name.
    """

    def __init__(self, task: Task, parts: tuple[Part, ...]):
        self.task, self.parts = task, parts
        shown = [part for part in parts if part.shown]
        self.names = tuple(name for part in shown for name in part.gives)
        self.sources = tuple(part.name for part in shown for _ in part.gives)
        self._way_back = list(self._steps_back())

    def __len__(self) -> int:
        return len(self.names)

    def forward(self, observation: Any) -> Any:
        """Observations (..., d) in physical units as coordinates (..., m)."""
        library = library_of(observation)
        if isinstance(observation, np.ndarray) and observation.ndim == 1:
            with suppress(ArithmeticError, ValueError):  # of infinities, which NumPy passes on
                return np.array(
                    self._of_one(observation.tolist()), np.result_type(observation, np.float32)
                )
        known = {name: observation[..., i] for i, name in enumerate(self.task.feature_names)}
        for part in self.parts:
            _Step(part, False).calculate(library, known)
        return library.stack([known[name] for name in self.names], -1)

    def _of_one(self, numbers: list[float]) -> list[float]:
        """The coordinates (m,) of one observation (d,), several times as fast as in arrays."""
        steps, shown = self._program
        for forward, places, soft in steps:
            numbers += forward(_PLAIN, [numbers[i] for i in places], soft)
        return [numbers[i] for i in shown]

    @cached_property
    def _program(self) -> tuple[list[tuple[Callable[..., Columns], list[int], float]], list[int]]:
        """The formulas with the places of what each takes, and the places of the coordinates.

        Places are among the observation's numbers and, after them, all that the formulas give.
        """
        names, steps = [*self.task.feature_names], []
        for part in self.parts:
            steps.append((FORMULAS[part.formula].forward, [*map(names.index, part.of)], part.soft))
            names += part.gives
        return steps, [*map(names.index, self.names)]

    def inverse(self, coordinates: Any) -> Any:
        """Coordinates (..., m) as observations (..., d) in physical units.

        Features that the coordinates don't tell are 0; a heading that they don't tell is along the
        world's x axis; a quaternion has a w that isn't negative, an angle is in the range of its
        feature, or else within half a turn of 0.
        """
        library = library_of(coordinates)
        known = {name: coordinates[..., i] for i, name in enumerate(self.names)}
        for step in self._way_back:
            if isinstance(step, str):
                known[step] = coordinates[..., 0] * 0
            else:
                step.calculate(library, known)
        return library.stack([in_range(known[each.name], each) for each in self.task.features], -1)

    @cached_property
    def not_decoded(self) -> tuple[str, ...]:
        """Features that the inverse doesn't give back, such as a position in the world."""
        tilted = {name for part in self.parts if part.formula == "tilt" for name in part.of}
        return tuple(n for n in self.task.feature_names if n in tilted or n in self._way_back)

    def _steps_back(self) -> Iterator["_Step | str"]:
        """Steps that lead from coordinates to features; the name of a feature sets it to 0."""
        known = {*self.names}
        turned = {n for part in self.parts if part.name.endswith(".heading") for n in part.of}
        steps = [_Step(part, is_inverse) for part in self.parts for is_inverse in (True, False)]
        while missing := [name for name in self.task.feature_names if name not in known]:
            before = len(known)
            for step in steps:
                if known.issuperset(step.takes) and not known.issuperset(step.gives):
                    yield step
                    known.update(step.gives)
            if len(known) == before:
                # headings first, as others may follow from them
                lost = min(missing, key=lambda name: name not in turned)
                yield lost
                known.add(lost)

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """The coordinates as features: their names, units, and usual ranges where known."""
        known = {each.name: each for each in self.task.features}
        for part in self.parts:
            of = [known[name] for name in part.of]
            known |= zip(part.gives, _described(part, of), strict=True)
        return tuple(known[name] for name in self.names)


def _described(part: Part, of: list[Feature]) -> list[Feature]:
    if part.formula == "same":
        return [of[0].replace(name=part.name)]
    of = of[: 2 if part.formula in ("turned", "polar", "difference") else 3]
    sizes = [
        max(-each.low, each.high) for each in of if each.low is not None and each.high is not None
    ]
    most = max(sizes) if len(sizes) == len(of) else None
    if part.formula == "difference" and most is not None:
        most *= 2
    unit, plain = of[0].unit, part.formula in ("circle", "tilt", "heading", "attitude")
    made = []
    for name in part.gives:
        if plain or (part.formula == "polar" and not name.endswith(".length")):
            made.append(Feature(name=name, low=-1.0, high=1.0, bounded=True))
        elif most is None:
            made.append(Feature(name=name, unit=unit))
        else:
            low = 0.0 if part.formula == "polar" else -most
            made.append(Feature(name=name, unit=unit, low=low, high=most))
    return made


def in_range(values: Any, feature: Feature) -> Any:
    """An angle in its feature's range, or within half a turn of 0; other values as they are."""
    if not feature.is_angle:
        return values
    low, high = feature.low, feature.high
    if low is None or high is None or high - low > _FULL_TURN:
        return wrapped(values)
    middle = (low + high) / 2
    return wrapped(values - middle) + middle


def wrapped(angle: Any) -> Any:
    """Angles [rad] within half a turn of 0."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def library_of(values: Any) -> Any:
    """The library of an array: NumPy, or torch."""
    return sys.modules["torch" if is_torch(values) else "numpy"]


def is_torch(values: Any) -> bool:
    """Whether they are a torch tensor, of any class; torch isn't imported for the answer."""
    return type(values).__module__.partition(".")[0] == "torch"
