"""Learners: an algorithm with its hyperparameters, under the name that tables give it."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.errors import InputError
from jbrep.records.document import read_toml
from jbrep.records.record import Record
from jbrep.rl.overrides import overridden
from jbrep.rl.presets import (
    ALGORITHMS,
    PRESETS,
    Hyperparameters,
    base_name,
    get_preset,
    usual_preset,
)
from jbrep.rl.settings import MAX_NAME, LearnerName
from jbrep.text import slug

_SUFFIX = ".toml"
_MOST_LETTERS = 60  # of a name made from overrides


class Learner(Record, frozen=True, kw_only=True):
    """An algorithm with its hyperparameters."""

    name: LearnerName  # what tables call it: sac-wide, or a name of the user's
    algorithm: str  # a key of ALGORITHMS
    preset: str  # the base, one of PRESETS
    overrides: Mapping[str, Any] = {}  # what is set differently there
    # the values of settings, one of which each seed of a study draws
    draws: Mapping[str, tuple[Any, ...]] = {}

    @classmethod
    def of(cls, name: str) -> "Learner":
        """The learner that is an algorithm with a preset, the usual one if it names none."""
        algorithm, _, preset = name.partition("-")
        preset = preset or usual_preset(algorithm)
        get_preset(preset, algorithm)
        return cls(name=base_name(algorithm, preset), algorithm=algorithm, preset=preset)

    @classmethod
    def given(
        cls, algorithm: str, preset: str, overrides: Mapping[str, Any], name: str = ""
    ) -> "Learner":
        """The learner of an algorithm with a preset or preset file, and what is set differently."""
        in_file: Mapping[str, Any] = {}
        base, beginning = preset, base_name(algorithm, preset)
        if preset.endswith(_SUFFIX):
            base, in_file = read_preset(Path(preset), algorithm)
            beginning = f"{base_name(algorithm, base)}+{slug(Path(preset).stem)}"
        return cls(
            name=name or usual_name(beginning, overrides),
            algorithm=algorithm,
            preset=base,
            overrides={**in_file, **overrides},
        )

    @classmethod
    def of_table(cls, name: str, table: Mapping[str, Any]) -> "Learner":
        """The learner that a study's table describes.

        Args:
            name: of the learner.
            table: `base`, an algorithm with or without a preset, by default the name; `preset`, if
                `base` names none, which may be a file; `draws`, lists of values by setting; and
                overrides.
        """
        overrides, name = dict(table), cls.of(name).name if name in ALGORITHMS else name
        draws = _draws(overrides.pop("draws", {}))
        base, preset = overrides.pop("base", name), overrides.pop("preset", "")
        if not isinstance(base, str) or not isinstance(preset, str):
            raise InputError("base and preset must be text")
        start = cls.of(base)
        if preset and base != start.algorithm:
            raise InputError(f"base is {base} and preset {preset}: only one may name a preset")
        learner = cls.given(start.algorithm, preset or start.preset, overrides, name)
        learner = learner.replace(draws=draws)
        for each in learner.variants:
            _ = each.hyperparameters  # raises if invalid
        presets = {base_name(each, its) for each in ALGORITHMS for its in ALGORITHMS[each].presets}
        if name in presets and learner != cls.of(name):
            raise InputError(f'that is a preset\'s name: choose another, with base = "{base}"')
        return learner

    def overridden(self, overrides: Mapping[str, Any]) -> "Learner":
        """The same with more set differently, which its name then says."""
        name = usual_name(self.name, overrides)
        return self.replace(name=name, overrides={**self.overrides, **overrides})

    def drawn(self, seed: int) -> "Learner":
        """The same under its name, with the values that a seed draws, whatever else is drawn."""
        chosen = {
            name: values[np.random.default_rng([seed, *name.encode()]).integers(len(values))]
            for name, values in self.draws.items()
        }
        return self.replace(overrides={**self.overrides, **chosen}, draws={})

    @property
    def variants(self) -> Iterator["Learner"]:
        """The same without draws, then with each value that may be drawn, one at a time."""
        each = ({name: value} for name, values in self.draws.items() for value in values)
        for drawn in ({}, *each):
            yield self.replace(overrides={**self.overrides, **drawn}, draws={})

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The preset's with the overrides, all checked."""
        return overridden(self.algorithm, self.preset, self.overrides)

    @property
    def table(self) -> dict[str, Any]:
        """A table that `of_table` takes, without a file; empty for a preset."""
        base = base_name(self.algorithm, self.preset)
        draws = {name: [*values] for name, values in self.draws.items()}
        own = {**self.overrides, **({"draws": draws} if draws else {})}
        return {"base": base, **own} if own or self.name != base else {}


def _draws(given: Any) -> dict[str, tuple[Any, ...]]:
    if not isinstance(given, dict) or not all(isinstance(v, list) and v for v in given.values()):
        raise InputError(
            f"draws is {given!r}: it must be a table of lists, such as "
            "{learning_rate = [1e-4, 3e-4, 1e-3]}"
        )
    return {name: tuple(values) for name, values in given.items()}


def usual_name(base: str, overrides: Mapping[str, Any]) -> str:
    """A name made from overrides: sac+learning_rate=0.0003+net_arch=64-64."""
    parts = [f"{name}={_short(value)}" for name, value in overrides.items()]
    name = "+".join((base, *parts))
    if len(name) <= _MOST_LETTERS:
        return name
    text = json.dumps(overrides, sort_keys=True, default=str)
    short = f"{base}+{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return short[-MAX_NAME:]


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return re.sub("-{2,}", "-", slug(text.strip('[]{}"')))


def read_preset(path: Path, algorithm: str) -> tuple[str, dict[str, Any]]:
    """The base and the overrides of an algorithm in a preset file.

    It is TOML, with a table for each algorithm: `base`, the preset that it begins with (the usual
    one by default), and overrides.
    """
    usual = usual_preset(algorithm)
    tables = read_toml(path)
    if not isinstance(tables.get(algorithm), dict):
        raise InputError(
            f"{path} has no table [{algorithm}]: it has {', '.join(tables) or 'none at all'}"
        )
    overrides = tables[algorithm]
    base = overrides.pop("base", usual)
    try:
        if not isinstance(base, str):
            raise InputError(f"base is {base!r}: it must be one of {', '.join(PRESETS)}")
        overridden(algorithm, base, overrides)
    except InputError as error:
        raise InputError(f"{path}, [{algorithm}]: {error}") from None
    return base, overrides
