"""Learners: an algorithm with its settings, under the name that tables give it."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jbrep.errors import InputError, choose
from jbrep.records.toml import read_toml
from jbrep.rl.fields import LEARNER, MAX_NAME
from jbrep.rl.names import PAPER, base_name
from jbrep.rl.overrides import used_settings
from jbrep.rl.presets import ALGORITHMS, PRESETS
from jbrep.text import slug

_SUFFIX = ".toml"
_MOST_LETTERS = 60  # of a name made from settings


@dataclass(frozen=True)
class Learner:
    """An algorithm with its settings.

    Attributes:
        name: what tables call it: ddpg, with the preset paper; sac-modern, with another; or a name
            of the user's.
        algorithm: a key of ALGORITHMS.
        preset: the base, a key of PRESETS.
        overrides: what is set differently there.
    """

    name: str
    algorithm: str
    preset: str
    overrides: Mapping[str, Any]

    @classmethod
    def of(cls, name: str) -> "Learner":
        """The learner that is an algorithm with a preset.

        Raises:
            InputError: unknown algorithm or preset.
        """
        algorithm, _, preset = name.partition("-")
        used_settings(algorithm, preset or PAPER, {})
        return cls(name, algorithm, preset or PAPER, {})

    @classmethod
    def given(
        cls, algorithm: str, preset: str, overrides: Mapping[str, Any], name: str = ""
    ) -> "Learner":
        """The learner of an algorithm with a preset or preset file, and what is set differently.

        Raises:
            InputError: the preset file can't be used, or the name isn't one.
        """
        if not is_file(preset):
            usual = usual_name(base_name(algorithm, preset), overrides)
            return cls._named(name or usual, algorithm, preset, overrides)
        base, in_file = read_preset(Path(preset), algorithm)
        beginning = f"{base_name(algorithm, base)}+{slug(Path(preset).stem)}"
        usual = usual_name(beginning, overrides)
        return cls._named(name or usual, algorithm, base, {**in_file, **overrides})

    @classmethod
    def of_table(cls, name: str, table: Mapping[str, Any]) -> "Learner":
        """The learner that a study's table describes.

        Args:
            name: of the learner.
            table: `base`, an algorithm with or without a preset, by default the name; `preset`, if
                `base` names none, which may be a file; and settings.

        Raises:
            InputError: a base, preset or setting is unknown, or its value isn't allowed.
        """
        settings = dict(table)
        base, preset = settings.pop("base", name), settings.pop("preset", "")
        if not isinstance(base, str) or not isinstance(preset, str):
            raise InputError("base and preset must be text")
        start = cls.of(base)
        if preset and start.preset != PAPER:
            raise InputError(f"base is {base} and preset {preset}: only one may name a preset")
        learner = cls.given(start.algorithm, preset or start.preset, settings, name)
        used_settings(learner.algorithm, learner.preset, learner.overrides)
        if name in _preset_names() and learner != cls.of(name):
            raise InputError(f'it is a preset\'s name: give it another and base = "{base}"')
        return learner

    @property
    def table(self) -> dict[str, Any]:
        """A table that `of_table` takes, without a file; empty for a preset."""
        base = base_name(self.algorithm, self.preset)
        return {"base": base, **self.overrides} if self.overrides or self.name != base else {}

    @property
    def run_settings(self) -> dict[str, Any]:
        """Those of a Run."""
        return {
            "algorithm": self.algorithm,
            "preset": self.preset,
            "settings": self.overrides,
            "learner": self.name,
        }

    @classmethod
    def _named(
        cls, name: str, algorithm: str, preset: str, overrides: Mapping[str, Any]
    ) -> "Learner":
        if not LEARNER.allows(name) or not name.strip("."):
            raise InputError(f"{name!r} can't be a learner's name: it must be {LEARNER.words}")
        return cls(name, algorithm, preset, overrides)


def is_file(preset: str) -> bool:
    """Whether a preset's name is of a file."""
    return preset.endswith(_SUFFIX)


def usual_name(base: str, overrides: Mapping[str, Any]) -> str:
    """A name made from settings: sac+learning_rate=0.0003+net_arch=64-64."""
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
    """The base and the settings of an algorithm in a preset file.

    It is TOML, with a table for each algorithm: `base`, the preset that it begins with (paper by
    default), and settings.

    Raises:
        InputError: no such file, not such a file, or a setting that the algorithm can't have.
    """
    choose(algorithm, ALGORITHMS, "algorithm")
    tables = read_toml(path)
    if not isinstance(tables.get(algorithm), dict):
        raise InputError(
            f"{path} has no table [{algorithm}]: it has {', '.join(tables) or 'none at all'}"
        )
    settings = tables[algorithm]
    base = settings.pop("base", PAPER)
    try:
        if not isinstance(base, str):
            raise InputError(f"base is {base!r}: it must be one of {', '.join(PRESETS)}")
        used_settings(algorithm, base, settings)
    except InputError as error:
        raise InputError(f"{path}, [{algorithm}]: {error}") from None
    return base, settings


def write_preset(algorithm: str, base: str, settings: Mapping[str, Any]) -> str:
    """The text of a preset file."""
    lines = [f"[{algorithm}]", f"base = {json.dumps(base)}"]
    return "\n".join([*lines, *toml_lines(settings.items())]) + "\n"


def toml_lines(settings: Iterable[tuple[str, Any]]) -> list[str]:
    """Settings as lines of TOML."""
    return [f"{name} = {_toml(value)}" for name, value in settings]


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(toml_lines(value.items())) + " }"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps("none" if value is None else value)


def _preset_names() -> list[str]:
    return [base_name(algorithm, preset) for preset in PRESETS for algorithm in PRESETS[preset]]
