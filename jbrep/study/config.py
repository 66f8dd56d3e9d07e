"""What a study is: a TOML file, or the same in Python."""

import json
from collections.abc import Mapping
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from msgspec import UNSET, Meta, UnsetType

from jbrep.dataset.settings import MAX_ROOT_SEED
from jbrep.encoders.shipped import UNLEARNED
from jbrep.envs.domain import Domain, read_ranges
from jbrep.envs.names import find_spec
from jbrep.envs.task import MAX_EPISODE_STEPS, SHORT_NAMES
from jbrep.errors import InputError
from jbrep.records.document import Document
from jbrep.records.record import Record, from_plain, to_plain
from jbrep.records.storage import exists
from jbrep.records.toml import read_toml, toml_text
from jbrep.rl.learner import Learner
from jbrep.rl.presets import learns_from
from jbrep.rl.run import trainer_of
from jbrep.rl.settings import MAX_STEPS, Seed, TrainingSettings
from jbrep.stats.arms import FEWEST_UNITS
from jbrep.stats.power import Arms, obstacle
from jbrep.stats.rules import Planned, Rules
from jbrep.study.representations import (
    MAX_ENCODERS,
    ByName,
    Given,
    Representation,
    read_representation,
)
from jbrep.text import slug

_MOST_SEEDS = (1 << 16) - 1


class Data(Record, frozen=True, kw_only=True):
    """The data set that encoders are trained on: collected for the study, or an existing one."""

    steps: Annotated[
        int, Meta(ge=0, le=MAX_STEPS, description="Of states to collect for the encoders.")
    ] = 0
    seed: Annotated[
        int, Meta(ge=0, le=MAX_ROOT_SEED - MAX_ENCODERS, description="Of the first data set.")
    ] = 0
    sets: Annotated[
        int,
        Meta(
            ge=1,
            le=MAX_ENCODERS,
            description="Data sets of that size, of the seeds that follow.",
        ),
    ] = 1
    folder: Annotated[
        str,
        Meta(
            description="Existing data in place of steps: a data set, or a folder with TASK for "
            "each task."
        ),
    ] = ""

    def check(self) -> None:
        """As for `Record`."""
        if bool(self.steps) == bool(self.folder):
            raise InputError("it must have either steps, to collect, or the folder of a data set")
        if self.folder and self.sets != 1:
            raise InputError(f"sets is {self.sets}: it is left out where there is a folder")


class Study(TrainingSettings, Document, frozen=True, kw_only=True):
    """Tasks x algorithms x representations x seeds, and the settings that all runs share.

    No environment is made: `jbrep.study.prepare.check` finds out what that shows.
    """

    format = "jbrep study"
    format_version = 2

    tasks: Annotated[
        tuple[str, ...],
        Meta(
            min_length=1,
            title="a list of names",
            description="The Jitterbug's by name, others by their Gymnasium ids.",
        ),
    ]
    algorithms: Annotated[
        tuple[str, ...],
        Meta(
            min_length=1,
            title="a list of names, or tables",
            description="ddpg, td3, sac, ppo, a2c, trpo, tqc, crossq, each also with a preset, "
            "sac-modern; or a table of settings for each.",
        ),
    ]
    representations: Annotated[
        tuple[Given, ...],
        Meta(
            min_length=1,
            title="a list of names and tables",
            description="full, encoders by name, or tables: name with file, code, kind and its "
            "settings, or encoders.",
        ),
    ]
    seeds: Annotated[
        tuple[Seed, ...],
        Meta(
            min_length=1,
            title=f"a list of whole numbers, or how many (1 to {_MOST_SEEDS:,})",
            description="Of the runs.",
        ),
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
        Meta(
            title="a table",
            description='What each episode of all runs draws, such as delay = "0..2".',
        ),
    ] = UNSET
    data: Data | None = None  # None: the shipped encoders
    training: Annotated[
        Mapping[str, Any],
        Meta(
            description="Settings of the encoders that the study trains: epochs, batch_size, "
            "learning_rate, noise, seed.",
            extra={"default": "each method's own"},
        ),
    ] = {}
    learners: Mapping[str, Mapping[str, Any]] = {}  # the tables of algorithms, by name
    evaluations: Annotated[
        tuple[str, ...],
        Meta(
            title="a list of folders",
            description="From jbrep evaluate, whose diagnostics the report sets against returns; "
            "{task} stands for each task's name.",
        ),
    ] = ()
    verdicts: Rules = Rules()
    title: Annotated[str, Meta(max_length=200, description="What its report is called.")] = ""

    def check(self) -> None:
        """As for `Record`."""
        super().check()
        for name in ("tasks", "algorithms", "representations", "seeds"):
            values = list(getattr(self, name))
            if name == "representations":
                values = [each.name for each in self.observed]
            if len(set(values)) < len(values):
                raise InputError(f"{name} is {values}: it must have each once")
        self._check_tasks()
        Domain(**read_ranges(self.domain or {}))
        for algorithm in self.algorithms:
            for each in self.learner(algorithm).variants:
                trainer_of(each, self)
        self._check_data()
        self._check_verdicts()

    def learner(self, name: str) -> Learner:
        """The learner of that name: a preset, or one with settings of its own.

        Raises:
            InputError: a name or setting is unknown, or a value isn't allowed.
        """
        own = self.learners.get(name)
        return _learner(name, own) if own else Learner.of(name)

    def _check_data(self) -> None:
        """Check where data come from, and that the study can make its encoders of them."""
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
            f"{task}/{algorithm}/{each.name}": each
            for task, algorithm, each in product(self.tasks, self.algorithms, self.observed)
            if each.name != self.baseline
        }
        short = {full: name for name, full in SHORT_NAMES.items()}
        if self.verdicts.primary and (long := [task for task in self.tasks if task in short]):
            raise InputError(
                f"tasks has {long[0]}: say {short[long[0]]}, as tables do, where there are verdicts"
            )
        names = [each.name for each in self.observed]
        if (baseline := self.verdicts.baseline) not in {*names, Rules().baseline}:
            raise InputError(
                f"verdicts.baseline is {baseline!r}: it must be one of the representations, "
                f"{', '.join(names)}"
            )
        self._check_looks()
        for cell in self.verdicts.primary:
            if cell not in cells or not self.comparisons:
                raise InputError(
                    f"verdicts.primary has {cell}: it must be of TASK/ALGORITHM/REPRESENTATION of "
                    f"this study, compared with {self.baseline}"
                )
            for claim in self.verdicts.claims:
                if reason := obstacle(self.verdicts, claim, self.arms(cells[cell])):
                    raise InputError(
                        f"verdicts: no outcome could support {claim!r} of {cell}: {reason}"
                    )
        for each in self.observed:
            shares = each.shares(self.seeds)
            if min(shares) < 2 and len(set(shares)) > 1:
                runs = len(self.seeds)
                raise InputError(
                    f"{each.name} has {each.encoders} encoders for {runs} seeds: each must have "
                    f"one run, or each at least two, so give at most {runs // 2}, or {runs}"
                )

    def _check_looks(self) -> None:
        counts, looks = self.planned.counts, f"verdicts.looks are {list(self.verdicts.looks)}"
        if len(set(counts)) < len(counts):
            raise InputError(
                f"{looks}: of {len(self.seeds)} seeds, they come after "
                f"{' and '.join(map(str, counts))}"
            )
        if self.verdicts.primary and FEWEST_UNITS > counts[0] < counts[-1]:
            raise InputError(
                f"{looks}: the first comes after {counts[0]} seeds, and verdicts take "
                f"{FEWEST_UNITS}"
            )

    @property
    def baseline(self) -> str:
        """The representation that the others are compared with."""
        return self.verdicts.baseline_of(each.name for each in self.observed)

    def arms(self, representation: Representation) -> Arms:
        """How many runs are planned of a representation, and units of it and of the baseline."""
        (baseline,) = [each for each in self.observed if each.name == self.baseline]
        return Arms(len(self.seeds), self._units(representation), self._units(baseline))

    def _units(self, representation: Representation) -> int:
        """Encoders, if there are enough for tests; else runs."""
        encoders = len(representation.shares(self.seeds))
        return encoders if encoders >= FEWEST_UNITS else len(self.seeds)

    @property
    def planned(self) -> Planned:
        """What would reach verdicts, if the study were registered as it is."""
        return Planned(self.verdicts, self.seeds)

    @cached_property
    def observed(self) -> tuple[Representation, ...]:
        """What agents observe."""
        return tuple(read_representation(each, self.training) for each in self.representations)

    @property
    def comparisons(self) -> int:
        """How many times a representation is compared with the baseline."""
        return len(self.tasks) * len(self.algorithms) * (len(self.observed) - 1)

    def flat(self) -> dict[str, Any]:
        """Its settings, those of each learner under algorithms.NAME, as in its file."""
        plain = to_plain(self)
        learners = plain.pop("learners", {})
        return {**plain, **{f"algorithms.{name}": table for name, table in learners.items()}}

    def toml(self) -> str:
        """The file that describes it."""
        given = {
            name: value for name, value in to_plain(self).items() if value not in (None, [], {})
        }
        if learners := given.pop("learners", {}):
            given["algorithms"] = {name: learners.get(name, {}) for name in self.algorithms}
        if self.data:  # either steps or a folder is given there
            given["data"] = {n: value for n, value in given["data"].items() if value not in ("", 0)}
        return toml_text(given)

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
            lines.append("This study compares nothing: it has one representation.")
        elif len(self.seeds) == 1:
            lines.append("This study compares nothing: it has one seed.")
        elif not self.verdicts.primary:
            lines.append(
                "This study is exploratory: its report will give no verdicts, as its file names no "
                "cell in verdicts.primary."
            )
        for name in self.algorithms:
            learner = self.learner(name)
            first = learns_from(learner.algorithm, learner.hyperparameters)
            if self.steps <= first:
                lines.append(
                    f"{name} learns from step {first:,} on: {self.steps:,} steps leave its "
                    "policies as they were drawn."
                )
        shipped = [
            each.name
            for each in self.observed
            if isinstance(each, ByName) and not self.data and each.name not in UNLEARNED
        ]
        if shipped:
            lines.append(
                f"Encoders that ship with jbrep: {', '.join(shipped)}. Your own are tables with a "
                "file: {name = ..., file = ...}."
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
        if "learners" in given:  # which files of jbrep have beside names
            raise InputError("unknown 'learners': settings of an algorithm are in algorithms.NAME")
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
    if type(given.get("seeds")) is int and 0 < given["seeds"] <= _MOST_SEEDS:
        given["seeds"] = [*range(given["seeds"])]
    if isinstance(tables := given.get("algorithms"), dict):
        learners = {name: _learner(name, table).table for name, table in tables.items()}
        given["algorithms"] = [*tables]
        given["learners"] = {name: table for name, table in learners.items() if table}
    return from_plain(given, Study)


def _learner(name: str, table: Any) -> Learner:
    """The learner that a table of algorithms describes.

    Raises:
        InputError: as `Learner.of_table`.
    """
    if not isinstance(table, dict):
        raise InputError(f"algorithms.{name} is {table!r}: it must be a table")
    try:
        return Learner.of_table(name, table)
    except InputError as error:
        raise InputError(f"[algorithms.{name}]: {error}") from None
