"""What a study is: a TOML file, checked."""

import json
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_origin

from jbrep.dataset.settings import CollectSettings
from jbrep.encoders import FULL
from jbrep.envs.names import find_spec, short_names
from jbrep.envs.task import MAX_EPISODE_STEPS
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS
from jbrep.records.storage import exists
from jbrep.records.toml import read_toml
from jbrep.rl.learner import Learner
from jbrep.rl.names import CPU, FLOAT32
from jbrep.rl.run import Run
from jbrep.stats.arms import FEWEST
from jbrep.stats.power import Arms, obstacle
from jbrep.stats.rules import Planned, Rules
from jbrep.study.representations import (
    MAX_ENCODERS,
    ByName,
    Given,
    Representation,
    name_of,
    read_representation,
)
from jbrep.text import slug

_MOST_SEEDS = (1 << 16) - 1
_RUN_SETTINGS = (
    *("steps", "evaluate_every", "evaluation_episodes", "final_episodes"),
    *("trainer", "precision", "device"),
)
_ITEMS: dict[Any, tuple[type, ...]] = {  # of lists, by the type of the field
    tuple[str, ...]: (str,),
    tuple[int, ...]: (int,),
    tuple[float, ...]: (float, int),
    tuple[Given, ...]: (str, dict),
}
_ANY_TASK = TASKS["face_direction"].describe()


@dataclass(frozen=True)
class Data:
    """The data set that encoders are trained on: collected for the study, or an existing one."""

    steps: int = 0
    seed: int = 0
    sets: int = 1  # to collect, of seed, seed + 1, ...; encoder i of several learns from set i
    folder: str = ""  # a data set, or a folder with one for each task


@dataclass(frozen=True, kw_only=True)
class Study:
    """Tasks x algorithms x representations x seeds, and the settings that all runs share.

    No environment is made: `jbrep.study.prepare.check` finds out what that shows.
    """

    tasks: tuple[str, ...]  # the Jitterbug's by their names, others by their ids
    algorithms: tuple[str, ...]
    representations: tuple[Given, ...]  # names, and tables of users' own encoders
    seeds: tuple[int, ...]
    steps: int
    evaluate_every: int = 10_000
    evaluation_episodes: int = 10
    final_episodes: int = 0  # of the last evaluation; 0: ten times as many as of the others
    trainer: str = ""  # cohort or sb3; by default cohort, for the algorithms that it has
    precision: str = FLOAT32  # of products of matrices: float32 or bfloat16
    device: str = CPU  # of gradient steps: cpu, cuda, or auto, which is cuda if there is one
    episode_steps: int | None = None  # time limit; None: each task's own
    environment: Mapping[str, Any] = field(default_factory=dict)  # arguments of environments
    data: Data | None = None  # None: the shipped encoders
    training: Mapping[str, Any] = field(default_factory=dict)  # of encoders, other than the usual
    learners: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # with own settings
    evaluations: tuple[str, ...] = ()  # folders from jbrep evaluate; {task} is each task's name
    verdicts: Mapping[str, Any] = field(default_factory=dict)  # arguments of Rules

    def __post_init__(self) -> None:
        for name in ("tasks", "algorithms", "representations", "seeds"):
            values = list(getattr(self, name))
            names = map(name_of, values) if name == "representations" else values
            if not values or len(set(map(repr, names))) < len(values):
                raise InputError(f"{name} is {values}: it must have one or more, each once")
        self._check_tasks()
        for algorithm in self.algorithms:
            settings = self.learner(algorithm).run_settings
            Run(task=_ANY_TASK, **settings, **self.run_settings).check_trainer()
        for seed in self.seeds:
            Run(task=_ANY_TASK, seed=seed)  # checks the number
        self._check_data()
        self._check_verdicts()

    def learner(self, name: str) -> Learner:
        """The learner of that name: a preset, or one with settings of its own.

        Raises:
            InputError: a name or setting is unknown, or a value isn't allowed.
        """
        if name not in self.learners:
            return Learner.of(name)
        try:
            return Learner.of_table(name, self.learners[name])
        except InputError as error:
            raise InputError(f"[algorithms.{name}]: {error}") from None

    def _check_data(self) -> None:
        """Check where data come from, and that the study can make its encoders of them."""
        if self.data and bool(self.data.steps) == bool(self.data.folder):
            raise InputError("data must have either steps, to collect, or the folder of a data set")
        if self.data and not 1 <= self.data.sets <= (1 if self.data.folder else MAX_ENCODERS):
            raise InputError(
                f"data.sets is {self.data.sets}: it must be from 1 to {MAX_ENCODERS:,} where data "
                "are collected, and is left out where there is a folder"
            )
        if self.data and self.data.steps:
            for seed in (self.data.seed, self.data.seed + self.data.sets - 1):
                CollectSettings(steps=self.data.steps, seed=seed)  # checks the numbers
        if self.training and not self.data:
            raise InputError("training is for encoders made by the study: [data] is missing")
        for given, representation in zip(self.representations, self.observed, strict=True):
            if not isinstance(representation, ByName):
                continue
            if not (isinstance(given, str) or self.data):
                raise InputError(
                    f"representation {representation.name} is trained by the study, on the states "
                    "that [data] gives: [data] is missing"
                )
            sets = self.data.sets if self.data else 1
            if sets < (representation.encoders or 1) and not representation.is_drawn:
                raise InputError(
                    f"representation {representation.name}: {representation.kind} has no seed, so "
                    "encoders of the same data are the same: leave out encoders, or collect as "
                    "many data.sets"
                )

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

    def _check_verdicts(self) -> None:
        """Check that what is to be decided is there, and that the runs could decide it."""
        cells = {
            "/".join((task, algorithm, name)): each
            for task in self.tasks
            for algorithm in self.algorithms
            for name, each in ((each.name, each) for each in self.observed)
            if name != FULL
        }
        short = {full: name for name, full in short_names().items()}
        if self.rules.primary and (long := [task for task in self.tasks if task in short]):
            raise InputError(
                f"tasks has {long[0]}: say {short[long[0]]}, as tables do, where there are verdicts"
            )
        counts = Planned(self.rules, self.seeds).counts
        if len(set(counts)) < len(counts):
            raise InputError(
                f"verdicts.looks are {list(self.rules.looks)}: of {len(self.seeds)} seeds, they "
                f"come after {' and '.join(map(str, counts))}"
            )
        for cell in self.rules.primary:
            if cell not in cells or not self.comparisons:
                raise InputError(
                    f"verdicts.primary has {cell}: it must be of TASK/ALGORITHM/REPRESENTATION of "
                    f"this study, compared with {FULL}"
                )
            for claim in self.rules.claims:
                if reason := obstacle(self.rules, claim, self.arms(cells[cell])):
                    raise InputError(
                        f"verdicts: no outcome could support {claim!r} of {cell}: {reason}"
                    )
        for each in self.observed:
            shares = each.shares(self.seeds)
            if min(shares) < 2 and len(set(shares)) > 1:
                raise InputError(
                    f"{each.name} has {each.encoders} encoders for {len(self.seeds)} seeds: each "
                    "encoder must have as many runs, or at least two"
                )

    def arms(self, representation: Representation) -> Arms:
        """How many runs are planned of a representation, and of the full observation."""
        runs, encoders = len(self.seeds), len(representation.shares(self.seeds))
        return Arms(runs, encoders if encoders >= FEWEST else runs, runs)

    @cached_property
    def rules(self) -> Rules:
        """How verdicts are reached."""
        return Rules(**_checked(Rules, dict(self.verdicts), "verdicts."))

    @cached_property
    def observed(self) -> tuple[Representation, ...]:
        """What agents observe."""
        return tuple(read_representation(each, self.training) for each in self.representations)

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
        lines = [
            f"The seeds, {len(self.seeds)} in number, share the {each.encoders} encoders of "
            f"{each.name} unevenly."
            for each in self.observed
            if len(set(each.shares(self.seeds))) > 1
        ]
        if not self.comparisons:
            lines.append(
                f"This study compares nothing: representations must have {FULL} and at least one "
                "other."
            )
        elif not self.rules.primary:
            lines.append(
                "This study is exploratory: its report will give no verdicts, as its file names no "
                "cell in verdicts.primary."
            )
        return lines


def read_study(path: Path) -> Study:
    """A study from its TOML file.

    Raises:
        InputError: no such file, invalid TOML, or a name or value that is unknown, missing or out
            of range.
    """
    if not exists(path):
        raise InputError(f"no study at {path}: it must be a TOML file")
    given = read_toml(path)
    try:
        study = as_study(given)
        for task in study.tasks:
            find_spec(task)
        return study
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def as_study(given: Mapping[str, Any]) -> Study:
    """A study from parsed TOML or JSON; a number of seeds n stands for the seeds 0 to n - 1.

    Tables of algorithms become names and learners, which hold what preset files say.

    Raises:
        InputError: a name or value is unknown, missing or out of range.
    """
    given = dict(given)
    if "data" in given:
        given["data"] = Data(**_checked(Data, given["data"], "data."))
    if type(given.get("seeds")) is int and 0 < given["seeds"] <= _MOST_SEEDS:
        given["seeds"] = list(range(given["seeds"]))
    if isinstance(tables := given.get("algorithms"), dict):
        given |= {"algorithms": list(tables), "learners": tables}
    study = Study(**_checked(Study, given, ""))
    named = ((name, study.learner(name).table) for name in study.algorithms)
    return replace(study, learners={name: table for name, table in named if table})


def known(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a study that its JSON says, which has null where there is nothing."""
    return {name: value for name, value in settings.items() if value is not None}


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
    inner = _ITEMS.get(kind)
    if inner:
        items = value if isinstance(value, list) else [None]
        if not all(type(item) in inner for item in items):
            number = f", or how many (1 to {_MOST_SEEDS})" if name == "seeds" else ""
            words = " and ".join(each.__name__ for each in inner)
            raise InputError(f"{name} is {value!r}: it must be a list of {words}{number}")
        return tuple(items)
    scalar = {int: (int,), int | None: (int,), str: (str,), float: (float, int)}.get(kind)
    if scalar and type(value) not in scalar:
        raise InputError(f"{name} is {value!r}: it must be of type {scalar[0].__name__}")
    if get_origin(kind) is Mapping and not isinstance(value, dict):
        raise InputError(f"{name} is {value!r}: it must be a table")
    if name == "learners" and (bad := [n for n, each in value.items() if type(each) is not dict]):
        raise InputError(f"algorithms.{bad[0]} is {value[bad[0]]!r}: it must be a table")
    return value
