"""What a study is: a TOML file, checked."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from jbrep.dae.training import Training
from jbrep.encoders import FULL
from jbrep.encoders.encoder import IDENTITY
from jbrep.encoders.names import USUAL_ARCHITECTURE, EncoderName
from jbrep.envs.names import find_spec
from jbrep.envs.task import MAX_EPISODE_STEPS
from jbrep.errors import InputError
from jbrep.files.storage import read_regular
from jbrep.jitterbug.tasks import TASKS
from jbrep.methods.fit import get_kind
from jbrep.rl.presets import get_preset
from jbrep.rl.run import Run
from jbrep.text import slug

_MAX_BYTES = 1 << 20
_MOST_SEEDS = (1 << 16) - 1
_RUN_SETTINGS = ("steps", "evaluate_every", "evaluation_episodes")
_ANY_TASK = TASKS["face_direction"].describe()
_TRAINING: dict[str, tuple[type, ...]] = {  # settings of encoders, with their types
    "epochs": (int,),
    "batch_size": (int,),
    "learning_rate": (float, int),
    "noise": (float, int),
    "seed": (int,),
}


@dataclass(frozen=True)
class Data:
    """The data set that encoders are trained on: collected for the study, or an existing one."""

    steps: int = 0
    seed: int = 0
    folder: str = ""  # a data set, or a folder with one for each task


@dataclass(frozen=True)
class Representation:
    """What an agent observes."""

    name: str  # full, or the name of an encoder: dae-8, dae-deep-8, pca-8
    kind: str
    training: Training  # of its encoder; only some settings matter to each kind

    @property
    def encoder(self) -> str:
        """The name of its encoder."""
        return self.kind if self.name == FULL else self.name

    @classmethod
    def of(cls, name: str, training: Mapping[str, Any]) -> "Representation":
        """The representation of that name.

        Raises:
            InputError: no such representation, or invalid training settings.
        """
        if name == FULL:
            return cls(name, IDENTITY, _training(None, USUAL_ARCHITECTURE, training))
        kind, architecture, latent = parts = EncoderName.parse(name)
        settings = get_kind(kind).settings
        taken = architecture == USUAL_ARCHITECTURE or "architecture" in settings
        if latent is None or "latent" not in settings or not taken or str(parts) != name:
            raise InputError(
                f"unknown representation {name!r}: it must be {FULL}, or a kind and a latent size, "
                "such as dae-8, dae-deep-8, pca-8 or random-8"
            )
        return cls(name, kind, _training(latent, architecture, training))


def _training(latent: int | None, architecture: str, settings: Mapping[str, Any]) -> Training:
    if unknown := [name for name in settings if name not in _TRAINING]:
        raise InputError(f"unknown training.{unknown[0]}: it must be one of {', '.join(_TRAINING)}")
    for name, value in settings.items():
        if type(value) not in _TRAINING[name]:
            kind = _TRAINING[name][0].__name__
            raise InputError(f"training.{name} is {value!r}: it must be of type {kind}")
    return Training.of(latent, architecture, **settings)


@dataclass(frozen=True)
class Learner:
    """An algorithm with a preset."""

    name: str  # ddpg, with the preset paper; sac-modern, with another
    algorithm: str
    preset: str

    @classmethod
    def of(cls, name: str) -> "Learner":
        """The learner of that name.

        Raises:
            InputError: unknown algorithm or preset.
        """
        algorithm, _, preset = name.partition("-")
        get_preset(preset or "paper", algorithm)
        return cls(name, algorithm, preset or "paper")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Tasks x algorithms x representations x seeds, and the settings that all runs share.

    No environment is made: `jbrep.study.prepare.check` finds out what that shows.
    """

    tasks: tuple[str, ...]  # the Jitterbug's by their names, others by their ids
    algorithms: tuple[str, ...]
    representations: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int
    evaluate_every: int = 10_000
    evaluation_episodes: int = 10
    episode_steps: int | None = None  # time limit; None: each task's own
    environment: Mapping[str, Any] = field(default_factory=dict)  # arguments of environments
    data: Data | None = None  # None: the shipped encoders
    training: Mapping[str, Any] = field(default_factory=dict)  # of encoders, other than the usual

    def __post_init__(self) -> None:
        for name in ("tasks", "algorithms", "representations", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InputError(f"{name} is {list(values)}: it must have one or more, each once")
        self._check_tasks()
        for algorithm in self.algorithms:
            Learner.of(algorithm)
        for name in self.representations:
            Representation.of(name, self.training)
        for seed in self.seeds:
            Run(task=_ANY_TASK, seed=seed, **self.run_settings)  # checks the numbers
        if self.data and bool(self.data.steps) == bool(self.data.folder):
            raise InputError("data must have either steps, to collect, or the folder of a data set")
        if self.training and not self.data:
            raise InputError("training is for encoders made by the study: [data] is missing")

    def _check_tasks(self) -> None:
        """Check what can be checked of tasks without making their environments."""
        folders: dict[str, str] = {}
        for task in self.tasks:
            folder = slug(task)
            if not folder.strip("."):
                raise InputError(f"unknown task {task!r}: it must be a name or a Gymnasium id")
            if (other := folders.setdefault(folder, task)) != task:
                raise InputError(f"{other} and {task} would share a folder: study one of them here")
        steps = self.episode_steps
        if steps is not None and not 1 <= steps <= MAX_EPISODE_STEPS:
            raise InputError(
                f"episode_steps is {steps}: it must be between 1 and {MAX_EPISODE_STEPS:,}"
            )
        try:
            json.dumps(self.environment, allow_nan=False)
        except (TypeError, ValueError):
            raise InputError(
                "environment has a date, or a number that is not finite: its values must be text, "
                "numbers, true or false, lists or tables"
            ) from None

    @property
    def run_settings(self) -> dict[str, Any]:
        """The settings of a Run that all runs share."""
        return {name: getattr(self, name) for name in _RUN_SETTINGS}

    @property
    def comparisons(self) -> int:
        """How many times a representation is compared with the full observation."""
        if FULL not in self.representations:
            return 0
        return len(self.tasks) * len(self.algorithms) * (len(self.representations) - 1)

    @property
    def notices(self) -> list[str]:
        """What to know before the first run."""
        if self.comparisons:
            return []
        return [
            f"This study compares nothing: representations must have {FULL} and at least one other."
        ]


def read_study(path: Path) -> Study:
    """A study from its TOML file.

    Raises:
        InputError: no such file, invalid TOML, or a name or value that is unknown, missing or out
            of range.
    """
    try:
        given = tomllib.loads(read_regular(path, _MAX_BYTES).decode())
    except FileNotFoundError:
        raise InputError(f"no study at {path}: it must be a TOML file") from None
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    try:
        study = as_study(given)
        for task in study.tasks:
            find_spec(task)
        return study
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def as_study(given: Mapping[str, Any]) -> Study:
    """A study from parsed TOML or JSON; a number of seeds n stands for the seeds 0 to n - 1.

    Raises:
        InputError: a name or value is unknown, missing or out of range.
    """
    given = dict(given)
    if "data" in given:
        given["data"] = Data(**_checked(Data, given["data"], "data."))
    if type(given.get("seeds")) is int and 0 < given["seeds"] <= _MOST_SEEDS:
        given["seeds"] = list(range(given["seeds"]))
    return Study(**_checked(Study, given, ""))


def _checked(kind: Any, given: Any, where: str) -> dict[str, Any]:
    """The given values, if each is known and of its field's type, and none is missing."""
    known = {f.name: f for f in fields(kind)}
    if not isinstance(given, dict):
        raise InputError(f"{where.rstrip('.')} is {given!r}: it must be a table")
    if unknown := [name for name in given if name not in known]:
        raise InputError(f"unknown {where}{unknown[0]}: it must be one of {', '.join(known)}")
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
            number = f", or how many (1 to {_MOST_SEEDS})" if name == "seeds" else ""
            raise InputError(f"{name} is {value!r}: it must be a list of {inner.__name__}{number}")
        return tuple(items)
    scalar = {int: int, int | None: int, str: str}.get(kind)
    if scalar and type(value) is not scalar:
        raise InputError(f"{name} is {value!r}: it must be of type {scalar.__name__}")
    if kind == Mapping[str, Any] and not isinstance(value, dict):
        raise InputError(f"{name} is {value!r}: it must be a table")
    return value
