"""What a study is: a TOML file, or the same in Python."""

import json
from collections.abc import Mapping
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from msgspec import UNSET, Meta, UnsetType
from msgspec.structs import asdict, force_setattr

from jbrep.collecting.policies import Uniform
from jbrep.dataset.manifest import MANIFEST
from jbrep.dataset.settings import MAX_ROOT_SEED
from jbrep.encoders.shipped import UNLEARNED
from jbrep.envs.description import describe, read_bounds
from jbrep.envs.domain import check_ranges
from jbrep.envs.names import find_spec, taken_for
from jbrep.envs.task import MAX_EPISODE_STEPS, SHORT_NAMES, EpisodeSteps, Id, Missing, Task
from jbrep.errors import InputError, choose
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.records.document import Document, read_toml, toml_text
from jbrep.records.record import Record, converted, from_plain, pattern, to_plain
from jbrep.records.storage import exists
from jbrep.rl.learner import Learner
from jbrep.rl.presets import learns_from
from jbrep.rl.settings import MAX_STEPS, Seed, TrainingSettings
from jbrep.stats.claims import NOT_WORSE
from jbrep.stats.pairs import FEWEST_UNITS, linked_units
from jbrep.stats.power import obstacle
from jbrep.stats.rules import Planned, Rules, Stated
from jbrep.studies.representations import (
    MAX_ENCODERS,
    ByName,
    Given,
    Representation,
    read_representation,
)
from jbrep.text import slug

_OF_EACH = "action_bounds", "features", "missing", "hide", "history"
_MOST_SEEDS = (1 << 16) - 1
UNIFORM = Uniform.kind
_DataName = Annotated[
    str,
    pattern(
        r"\A(?=.*[^.])[A-Za-z0-9_.-]{1,100}\Z",
        "1 to 100 letters of ASCII, digits, '_', '-' and '.', not only dots",
    ),
]


class Data(Record, frozen=True, kw_only=True):
    """Data that encoders are made from: collected for the study, or an existing data set."""

    steps: Annotated[
        int, Meta(ge=0, le=MAX_STEPS, description="States to collect for the encoders.")
    ] = 0
    policy: Annotated[
        str,
        Meta(
            min_length=1,
            description="A policy as for jbrep collect: uniform, heuristic, trained, a "
            "run's folder, or a mixture.",
        ),
    ] = UNIFORM
    seed: Annotated[
        int, Meta(ge=0, le=MAX_ROOT_SEED - MAX_ENCODERS, description="Seed of the first data set.")
    ] = 0
    sets: Annotated[
        Annotated[int, Meta(ge=1, le=MAX_ENCODERS)] | None,
        Meta(
            description="Data sets of that size, of the seeds that follow.",
            extra={"default": "one for each encoder of a representation"},
        ),
    ] = None
    folder: Annotated[
        str,
        Meta(
            description="Existing data in place of steps: a data set, or a folder with TASK for "
            "each task."
        ),
    ] = ""

    def check(self) -> None:
        if bool(self.steps) == bool(self.folder):
            raise InputError("it must have either steps, to collect, or the folder of a data set")
        if self.folder and self.sets not in (None, 1):
            raise InputError(f"sets is {self.sets}: it is left out where there is a folder")
        if self.folder and self.policy != UNIFORM:
            raise InputError(f"policy is {self.policy}: it is left out where there is a folder")

    def existing(self, task: str) -> Path:
        """The folder of an existing data set: the given one, or the task's within it."""
        folder = Path(self.folder)
        return folder if exists(folder / MANIFEST) else folder / slug(task)

    @property
    def table(self) -> dict[str, Any]:
        """What a file says of it."""
        usual = {"", 0, None, UNIFORM}
        return {name: value for name, value in to_plain(self).items() if value not in usual}


class TaskTable(Record, frozen=True, kw_only=True):
    """A task and what is said of it, as `jbrep.describe` takes it; features as their file had."""

    task: str
    name: Id | None = None  # what tables call it; by default as the task
    env: Mapping[str, Any] = {}
    episode_steps: EpisodeSteps | None = None
    action_bounds: str | None = None
    features: Mapping[str, Any] | None = None
    missing: Missing | None = None
    hide: tuple[str, ...] = ()
    history: Annotated[int, Meta(ge=1, le=1000)] | None = None
    domain: Mapping[str, Any] = {}

    def check(self) -> None:
        read_bounds(self.action_bounds)
        check_ranges(self.domain)

    @property
    def said(self) -> dict[str, Any]:
        """What is given."""
        return {name: value for name, value in to_plain(self).items() if value}


class Study(TrainingSettings, Document, frozen=True, kw_only=True):
    """Tasks x algorithms x representations x seeds, and the settings that all runs share.

    No environment is made: `jbrep.studies.prepare.check` finds out what that shows.
    """

    format = "jbrep study"
    format_version = 4

    tasks: Annotated[
        tuple[str, ...],
        Meta(
            min_length=1,
            description="The Jitterbug's by name, others by their Gymnasium ids; or tables: task, "
            "and what is said of it.",
        ),
    ]
    algorithms: Annotated[
        tuple[str, ...],
        Meta(
            min_length=1,
            description="ddpg, td3, sac, ppo, a2c, trpo, tqc, crossq, each also with a preset, "
            "sac-modern; or a table of settings for each.",
        ),
    ]
    representations: Annotated[
        tuple[Given, ...],
        Meta(
            min_length=1,
            description="full, encoders by name, or tables: name with file, code, kind and its "
            "settings, or encoders.",
        ),
    ]
    seeds: Annotated[
        tuple[Seed, ...], Meta(min_length=1, description="Seeds of the runs, or how many.")
    ]
    episode_steps: Annotated[
        Annotated[int, Meta(ge=1, le=MAX_EPISODE_STEPS)] | None,
        Meta(description="The time limit.", extra={"default": "each task's own"}),
    ] = None
    environment: Annotated[
        Mapping[str, Any], Meta(description="Arguments of all environments.")
    ] = {}
    domain: Annotated[
        Mapping[str, Any] | UnsetType,
        Meta(description='What each episode of all runs draws, such as delay = "0..2".'),
    ] = UNSET
    data: Mapping[str, Any] | None = None  # see `named_data`
    training: Annotated[
        Mapping[str, Any],
        Meta(
            description="Settings of the encoders that the study trains: epochs, batch_size, "
            "learning_rate, noise, seed.",
            extra={"default": "each method's own"},
        ),
    ] = {}
    evaluate: Annotated[
        bool | UnsetType,
        Meta(
            description="Evaluate these encoders on their data before the first run; the report "
            "sets it beside the returns."
        ),
    ] = UNSET
    learners: Mapping[str, Mapping[str, Any]] = {}  # the tables of algorithms, by name
    described: Mapping[str, TaskTable] = {}  # and those of tasks
    evaluations: Annotated[
        tuple[str, ...],
        Meta(
            description="Folders of jbrep evaluate, whose diagnostics the report compares with "
            "returns; {task} stands for each task's name."
        ),
    ] = ()
    verdicts: Rules = Rules()
    title: Annotated[str, Meta(max_length=200, description="What its report is called.")] = ""

    def check(self) -> None:
        super().check()
        force_setattr(self, "data", _read_data(self.data))
        force_setattr(self, "algorithms", tuple(self.learner(n).name for n in self.algorithms))
        for name in ("tasks", "algorithms", "representations", "seeds"):
            values = list(getattr(self, name))
            if name == "representations":
                values = [each.name for each in self.observed]
            if len(set(values)) < len(values):
                raise InputError(f"{name} is {values}: list each once")
        self._check_tasks()
        check_ranges(self.domain or {})
        self._check_data()
        self._check_verdicts()

    def learner(self, name: str) -> Learner:
        """The learner of that name: a preset, or one with settings of its own."""
        own = self.learners.get(name)
        if isinstance(own, dict) and "preset" in own:  # which could be any file
            raise InputError(f"learners.{name} has a preset: it must hold what that says")
        return _learner(name, own) if own else Learner.of(name)

    def task(self, name: str) -> Task:
        """A task as the study describes it, and by the name that the study calls it."""
        said = self.described[name].said if name in self.described else {}
        own = {"episode_steps": self.episode_steps, **said}
        for key, of_all in (("env", self.environment), ("domain", self.domain or {})):
            own[key] = {**of_all, **said.get(key, {})}
        own.pop("name", None)
        short = {full: each for each, full in SHORT_NAMES.items()}
        return describe(own.pop("task", name), **own).replace(name=short.get(name, name))

    @property
    def named_data(self) -> Mapping[str, Data]:
        """Its data by name; that of the only one is often empty."""
        return self.data or {}

    def data_of(self, representation: ByName) -> str:
        """The name of the data that a representation is made from."""
        if representation.data is None and (
            len(self.named_data) == 1 or representation.kind in UNLEARNED
        ):
            return next(iter(self.named_data))
        if representation.data and representation.data in self.named_data:
            return representation.data
        names = ", ".join(filter(None, self.named_data))
        expected = f"must be one of {names}" if names else "is left out, as [data] has no name"
        raise InputError(
            f"representation {representation.name}: its data is {representation.data or 'missing'}:"
            f" it {expected}"
        )

    def sets(self, name: str) -> int:
        """How many data sets there are of a name: as many as encoders need that are made of it."""
        data = self.named_data[name]
        if data.folder or data.sets:
            return data.sets or 1
        made = [each for each in self.observed if isinstance(each, ByName)]
        return max(each.encoders or 1 for each in made if self.data_of(each) == name)

    def _check_data(self) -> None:
        """Check where data come from, and that the study can make its encoders of them."""
        if (self.training or self.evaluate) and not self.data:
            key = "training" if self.training else "evaluate"
            raise InputError(f"{key} is for encoders made by the study: [data] is missing")
        unused = {*self.named_data}
        for given, representation in zip(self.representations, self.observed, strict=True):
            if not isinstance(representation, ByName):
                continue
            if not self.data:
                if isinstance(given, str):
                    continue
                raise InputError(
                    f"representation {representation.name} is trained by the study, on the states "
                    "that [data] gives: [data] is missing"
                )
            name = self.data_of(representation)
            unused.discard(name)
            if self.sets(name) < (representation.encoders or 1) and not representation.is_drawn:
                raise InputError(
                    f"representation {representation.name}: {representation.kind} has no seed, so "
                    "encoders of the same data are the same: leave out encoders, or collect as "
                    "many data.sets"
                )
        if unused:
            raise InputError(f"{data_key(min(unused))} is used by no representation: leave it out")

    def _check_tasks(self) -> None:
        """Check what can be checked of tasks without making their environments."""
        folders: dict[str, str] = {}
        for task in self.tasks:
            folder = slug(task)
            if not folder.strip("."):
                raise InputError(f"unknown task {task!r}: it must be a name or a Gymnasium id")
            if (other := folders.setdefault(folder, task)) != task:
                raise InputError(f"{other} and {task} would share a folder: study one of them here")
        try:
            json.dumps([self.environment, *map(asdict, self.described.values())], allow_nan=False)
        except (TypeError, ValueError):
            raise InputError(
                "env has a date, or a number that is not finite: its values must be text, "
                "numbers, true or false, lists or tables"
            ) from None

    def _check_verdicts(self) -> None:
        """Check that what is claimed can be compared, and that the runs could decide it."""
        short = {full: name for name, full in SHORT_NAMES.items()}
        if self.verdicts.claims and (long := [task for task in self.tasks if task in short]):
            raise InputError(
                f"tasks has {long[0]}: say {short[long[0]]}, as tables do, where there are verdicts"
            )
        names = [each.name for each in self.observed]
        if (baseline := self.verdicts.baseline) not in {*names, Rules().baseline}:
            raise InputError(
                f"verdicts.baseline is {baseline!r}: it must be one of the representations, "
                f"{', '.join(names)}"
            )
        stated = self.planned.rules.stated
        for claim in stated:
            if unknown := {claim.x, claim.y}.difference(names):
                raise InputError(
                    f"verdicts.claims has {str(claim)!r}: {min(unknown)} is none of the "
                    f"representations, {', '.join(names)}"
                )
        given = {task: self.described.get(task, TaskTable(task=task)) for task in self.tasks}
        without = [
            task
            for task, each in given.items()
            if short.get(each.task, each.task) not in HEURISTICS
            or each.hide
            or (each.history or 1) > 1
        ]
        absolute = all(claim.claim != NOT_WORSE for claim in stated)
        if without and not absolute and self.verdicts.reference == "":
            raise InputError(
                f"verdicts.claims has {NOT_WORSE.name!r}: name verdicts.reference, a policy or a "
                f"return that scores 1, as {without[0]} has no scripted policy"
            )
        for claim, units in self.units.items():
            if reason := obstacle(claim, units, self.verdicts.error):  # what others may pass on
                raise InputError(f"verdicts: no outcome could support {str(claim)!r}: {reason}")

    @property
    def baseline(self) -> str:
        """The representation that the others are compared with."""
        return self.verdicts.baseline_of(each.name for each in self.observed)

    @property
    def units(self) -> dict[Stated, int]:
        """How many runs or encoders each claim is tested on."""
        named = {each.name: each for each in self.observed}
        found = {}
        for claim in self.planned.rules.stated:
            sides = (named[claim.x], named[claim.y])
            linked = len(linked_units([[*map(each.encoder_seed, self.seeds)] for each in sides]))
            found[claim] = linked if linked >= FEWEST_UNITS else len(self.seeds)
        return found

    @property
    def planned(self) -> Planned:
        """What would reach verdicts, if the study were registered as it is."""
        rules = self.verdicts.replace(baseline=self.baseline)
        return Planned(rules, self.seeds, tuple(product(self.tasks, self.algorithms)))

    @cached_property
    def observed(self) -> tuple[Representation, ...]:
        """What agents observe."""
        return tuple(read_representation(each, self.training) for each in self.representations)

    def flat(self) -> dict[str, Any]:
        """Its settings, those of each learner under algorithms.NAME, as in its file."""
        plain = to_plain(self)
        learners, data = plain.pop("learners", {}), plain.pop("data") or {}
        tables = {f"algorithms.{name}": table for name, table in learners.items()}
        plain.pop("described")
        tables |= {f"tasks.{name}": each.said for name, each in self.described.items()}
        for name, table in data.items():
            tables[data_key(name)] = {**table, "sets": self.sets(name)}
        return {**plain, **tables}

    def toml(self) -> str:
        """The file that describes it."""
        given = to_plain(self)
        if learners := given.pop("learners", {}):
            given["algorithms"] = {name: learners.get(name, {}) for name in self.algorithms}
        given["env"] = given.pop("environment", {})
        if given.pop("described", None):
            tasks = ((name, self.described.get(name)) for name in self.tasks)
            given["tasks"] = [own.said if own else name for name, own in tasks]
        if self.data:
            tables = {name: data.table for name, data in self.named_data.items()}
            given["data"] = tables.get("", tables)
        return toml_text({n: v for n, v in given.items() if v not in (None, "", [], {})})

    @property
    def notices(self) -> list[str]:
        """What to know before the first run."""
        lines = [
            f"{len(self.seeds)} seeds share the {each.encoders} encoders of {each.name} unevenly."
            for each in self.observed
            if len(set(each.shares(self.seeds))) > 1
        ]
        if len(self.observed) == 1:
            lines.append("This study compares nothing: it has one representation.")
        elif len(self.seeds) == 1:
            lines.append("This study compares nothing: it has one seed.")
        elif not self.verdicts.claims:
            lines.append(
                "This study is exploratory: its report will give no verdicts, as its file has no "
                "verdicts.claims."
            )
        for learner in map(self.learner, self.algorithms):
            first = learns_from(learner.algorithm, learner.hyperparameters.within(self.steps))
            if self.steps <= first:
                lines.append(
                    f"{learner.name} learns from step {first:,} on: nothing is learned in "
                    f"{self.steps:,} steps."
                )
        return lines


_KEYS = dict.fromkeys(  # of a study's file
    sorted({*Study.__struct_fields__, "env", *_OF_EACH} - {"environment", "learners", "described"})
)


def read_study(path: Path) -> Study:
    """A study from its TOML file."""
    given = read_toml(path)
    try:
        for key in given:
            choose(key, _KEYS, "key")
        study = as_study(given)
        for task in study.tasks:
            own = study.described.get(task)
            find_spec(own.task if own else task)
        return study
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def as_study(given: Mapping[str, Any]) -> Study:
    """A study from parsed TOML or JSON; a number of seeds n stands for the seeds 0 to n - 1.

    Tables of algorithms become names and learners, which hold what preset files say, and those of
    tasks names and what is described; what is said of all tasks is said of each.
    """
    if not isinstance(given, Mapping):
        raise InputError(f"the study is {given!r}: it must be a file, a Study or a dictionary")
    given = dict(given)
    if "env" in given:
        given["environment"] = given.pop("env")
    of_all = {name: given.pop(name) for name in _OF_EACH if name in given}
    if isinstance(tasks := given.get("tasks"), list | tuple):
        each = [_task(i, of_all, given) for i, given in enumerate(tasks)]
        given["tasks"] = [own.name or own.task for own in each]
        if described := {own.name or own.task: own for own in each if {*own.said} - {"task"}}:
            given["described"] = described
    if type(seeds := given.get("seeds")) is int:
        if not 0 < seeds <= _MOST_SEEDS:
            raise InputError(f"seeds is {seeds}: it must be 1 to {_MOST_SEEDS:,}, or a list")
        given["seeds"] = [*range(seeds)]
    if isinstance(tables := given.get("algorithms"), dict):
        learners = {name: _learner(name, table).table for name, table in tables.items()}
        given["algorithms"] = [*tables]
        given["learners"] = {name: table for name, table in learners.items() if table}
    return from_plain(given, Study)


def _task(number: int, of_all: Mapping[str, Any], given: Any) -> TaskTable:
    """What is said of a task by its table, or by its name alone, and of all."""
    own = given if isinstance(given, Mapping) else {"task": taken_for(given)[0]}
    said = {**of_all, **own}
    if isinstance(path := said.get("features"), str):
        said["features"] = read_toml(Path(path))
    return from_plain(said, TaskTable, f"tasks[{number}]")


def _read_data(given: Mapping[str, Any] | None) -> Mapping[str, Data] | None:
    """Data by name, from the table of the only one, which has no name, or a table for each."""
    if given is None:
        return None
    tables = [name for name, value in given.items() if isinstance(value, Mapping | Data)]
    if not tables:
        return {"": from_plain(given, Data, "data")}
    if others := [name for name in given if name not in tables]:
        raise InputError(
            f"data has {others[0]} beside the table {tables[0]}: it must have either the keys of "
            "one, or a table for each"
        )
    for name in tables if tables != [""] else ():
        converted(name, _DataName, "the name of data")
    return {name: from_plain(given[name], Data, data_key(name)) for name in tables}


def data_key(name: str) -> str:
    """What files call data of a name, which is empty where there are no others."""
    return f"data.{name}" if name else "data"


def _learner(name: str, table: Any) -> Learner:
    """The learner that a table of algorithms describes."""
    if not isinstance(table, dict):
        raise InputError(f"algorithms.{name} is {table!r}: it must be a table")
    try:
        return Learner.of_table(name, table)
    except InputError as error:
        raise InputError(f"[algorithms.{name}]: {error}") from None
