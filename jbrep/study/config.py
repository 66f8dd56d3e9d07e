"""What a study is: a TOML file, checked."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from jbrep.dae.training import Training
from jbrep.encoders import FULL
from jbrep.errors import InputError
from jbrep.files.storage import read_regular
from jbrep.jitterbug.tasks import get_task
from jbrep.methods.fit import get_kind
from jbrep.rl.presets import get_preset
from jbrep.rl.run import Run

_MAX_BYTES = 1 << 20


@dataclass(frozen=True)
class Data:
    """The data set that encoders are made from: collected for the study, or there already."""

    steps: int = 0
    seed: int = 0
    folder: str = ""  # of data sets by task, or of the one


@dataclass(frozen=True)
class Representation:
    """How an agent sees the state."""

    name: str  # full, or as its encoder is called: dae-8, dae-deep-8, pca-8
    kind: str
    training: Training  # how its encoder is made, as far as that matters to the kind

    @property
    def encoder(self) -> str:
        """What its encoder is called."""
        return self.kind if self.name == FULL else self.name

    @classmethod
    def of(cls, name: str, training: Mapping[str, Any]) -> "Representation":
        """From its name.

        Raises:
            InputError: it is none, or can't be trained so.
        """
        if name == FULL:
            return cls(name, "identity", Training.of(0))
        parts = re.fullmatch(r"([a-z]+)(?:-([a-z]+))?-(\d{1,3})", name)
        if not parts or "latent" not in get_kind(parts[1]).settings:
            raise InputError(
                f"unknown representation {name!r}: {FULL}, or a kind and a latent size, such as "
                "dae-8, dae-deep-8, pca-8 or random-8, is needed"
            )
        try:
            how = Training.of(int(parts[3]), parts[2] or "paper", **training)
        except TypeError as error:
            raise InputError(f"training: {error}") from None
        return cls(name, parts[1], how)


@dataclass(frozen=True)
class Learner:
    """An algorithm with its settings."""

    name: str  # ddpg, with the paper's settings; sac-modern, with others
    algorithm: str
    preset: str

    @classmethod
    def of(cls, name: str) -> "Learner":
        """From its name.

        Raises:
            InputError: it is none.
        """
        algorithm, _, preset = name.partition("-")
        get_preset(preset or "paper", algorithm)
        return cls(name, algorithm, preset or "paper")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Tasks x algorithms x representations x seeds, and what they share."""

    tasks: tuple[str, ...]
    algorithms: tuple[str, ...]
    representations: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int
    evaluate_every: int = 10_000
    evaluation_episodes: int = 10
    data: Data | None = None  # None: encoders that ship
    training: Mapping[str, Any] = field(default_factory=dict)  # of encoders, where not usual

    def __post_init__(self) -> None:
        for name in ("tasks", "algorithms", "representations", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InputError(f"{name} is {list(values)}: one or more is needed, each once")
        for task in self.tasks:
            get_task(task)
        for algorithm in self.algorithms:
            Learner.of(algorithm)
        for name in self.representations:
            Representation.of(name, self.training)
        for seed in self.seeds:
            Run(  # whose numbers are in range
                task=self.tasks[0],
                seed=seed,
                steps=self.steps,
                evaluate_every=self.evaluate_every,
                evaluation_episodes=self.evaluation_episodes,
            )
        if self.data and bool(self.data.steps) == bool(self.data.folder):
            raise InputError("data needs either steps, to collect, or the folder of a data set")
        if self.training and not self.data:
            raise InputError("training is of encoders made for the study, so data is needed, too")

    @property
    def comparisons(self) -> int:
        """How many times a representation is compared with the full observation."""
        smaller = set(self.representations) - {FULL}
        return len(self.tasks) * len(self.algorithms) * len(smaller)


def read_study(path: Path) -> Study:
    """A study from its TOML file.

    Raises:
        InputError: no such file, no TOML, or something in it is unknown, missing or out of range.
    """
    try:
        given = tomllib.loads(read_regular(path, _MAX_BYTES).decode())
    except FileNotFoundError:
        raise InputError(f"no study at {path}: a TOML file is needed") from None
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no TOML: {error}") from None
    try:
        return as_study(given)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def as_study(given: dict[str, Any]) -> Study:
    """A study from what TOML or JSON gave; a count of seeds stands for the first so many.

    Raises:
        InputError: something in it is unknown, missing or out of range.
    """
    if "data" in given:
        given["data"] = Data(**_checked(Data, given["data"], "data."))
    if isinstance(given.get("seeds"), int) and 0 < given["seeds"] < 1 << 16:
        given["seeds"] = list(range(given["seeds"]))
    return Study(**_checked(Study, given, ""))


def _checked(kind: Any, given: Any, where: str) -> dict[str, Any]:
    """Every value known, and of its field's type."""
    known = {f.name: f for f in fields(kind)}
    if not isinstance(given, dict):
        raise InputError(f"{where.rstrip('.')} is {given!r}: a table is needed")
    if unknown := [name for name in given if name not in known]:
        raise InputError(f"unknown {where}{unknown[0]}: known are {', '.join(known)}")
    needed = [n for n, f in known.items() if f.default is MISSING and f.default_factory is MISSING]
    if missing := [name for name in needed if name not in given]:
        raise InputError(f"{where}{missing[0]} is missing")
    return {name: _typed(known[name].type, value, where + name) for name, value in given.items()}


def _typed(kind: Any, value: Any, name: str) -> Any:
    """A list as a tuple; anything else as it is."""
    inner = {tuple[str, ...]: str, tuple[int, ...]: int}.get(kind)
    if inner:
        items = value if isinstance(value, list) else [None]
        if not all(type(item) is inner for item in items):
            raise InputError(f"{name} is {value!r}: a list of {inner.__name__} is needed")
        return tuple(items)
    if kind in (int, str) and type(value) is not kind:
        raise InputError(f"{name} is {value!r}: {kind.__name__} is needed")
    return value
