"""A study's folder: where its files are, and which runs it has."""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from pathlib import Path

from jbrep.envs.description import describe
from jbrep.envs.instances import memory_of_each
from jbrep.envs.task import Task
from jbrep.errors import InputError, differences
from jbrep.records.document import read_document
from jbrep.records.record import to_plain
from jbrep.records.storage import exists, inside, make_folder
from jbrep.rl import Run
from jbrep.rl.files import RUN
from jbrep.rl.learner import Learner
from jbrep.study.config import Study
from jbrep.study.registration import REGISTRATION, Registration, read_registration
from jbrep.study.representations import Representation
from jbrep.study.work import Assigned
from jbrep.text import slug
from jbrep.training.trainer import get_device

STUDY = "study.json"
_GRID = (  # may change
    "tasks",
    "algorithms",
    "representations",
    "seeds",
    "evaluations",
    "title",
)


@dataclass(frozen=True)
class Cell:
    """One run of the grid."""

    task: str  # its name
    learner: Learner
    representation: Representation
    seed: int

    @property
    def label(self) -> str:
        """What it shares with the runs of other seeds: TASK/ALGORITHM/REPRESENTATION."""
        return f"{self.task}/{self.learner.name}/{self.representation.name}"

    @property
    def kind(self) -> tuple[str, str]:
        """What it shares with the runs that it can learn together with: task and settings."""
        return self.task, json.dumps([self.learner.name, self.learner.table], sort_keys=True)

    @property
    def name(self) -> str:
        """Its folder below the study's folder of runs."""
        parts = (slug(self.task), self.learner.name, self.representation.name, f"seed-{self.seed}")
        return "/".join(parts)


class Plan:
    """A study in its folder, which holds `runs`, and `data` and `encoders` if the study makes them.

    Args:
        study: what to run.
        folder: of this study alone.
    """

    def __init__(self, study: Study, folder: str | Path):
        self.study = study
        self.folder = Path(folder).absolute()  # workers may have another working directory

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All runs; those of the first seed come first."""
        study = self.study
        learners = [study.learner(algorithm) for algorithm in study.algorithms]
        grid = product(study.seeds, study.tasks, learners, study.observed)
        return tuple(Cell(task, each.drawn(seed), seen, seed) for seed, task, each, seen in grid)

    @cached_property
    def registration(self) -> Registration | None:
        """What was written down before the first run; None if nothing was."""
        return read_registration(self.folder)

    @property
    def device(self) -> str:
        """What gradient steps are taken on.

        Raises:
            InputError: there is no such device.
        """
        return str(get_device(self.study.device).type)

    def folder_of(self, cell: Cell) -> Path:
        """A run's folder."""
        return inside(self.folder, "runs", cell.name)

    def has_ended(self, cell: Cell) -> bool:
        """Whether a run has finished or failed."""
        return exists(self.folder_of(cell) / RUN)

    @property
    def unfinished(self) -> list[Cell]:
        """The runs that have neither finished nor failed."""
        return [cell for cell in self.cells if not self.has_ended(cell)]

    def task(self, name: str) -> Task:
        """A task with the study's arguments, time limit and domain; its environment is made once.

        Raises:
            InputError: as `describe`.
        """
        study = self.study
        return describe(name, study.environment, study.episode_steps, domain=study.domain or {})

    @cached_property
    def robot_memory(self) -> Callable[[str], int]:
        """Bytes that each environment of a task takes, by the task's name; measured once."""
        return cache(lambda name: memory_of_each(self.task(name)))

    def run(self, cell: Cell) -> Run:
        """What to train.

        Raises:
            InputError: as `describe`, or its representation has no encoder for its task.
        """
        made = self.encoders(cell.task) if self.study.data else None
        return Run(
            task=self.task(cell.task),
            learner=cell.learner,
            encoder=cell.representation.encoder(cell.task, cell.seed, made),
            encoder_seed=cell.representation.encoder_seed(cell.seed),
            representation=cell.representation.name,
            seed=cell.seed,
            registration=self.registration.sha256 if self.registration else None,
            **to_plain(self.study.training_settings),
        )

    @property
    def fingerprints(self) -> dict[str, str]:
        """The SHA-256 of each run's encoder, by the run's label and seed.

        Raises:
            InputError: one is missing.
        """
        return {
            f"{cell.label}/seed-{cell.seed}": self.run(cell).find_encoder().fingerprint
            for cell in self.cells
        }

    def assigned(self, cells: Iterable[Cell]) -> list[Assigned]:
        """Runs for a worker.

        Raises:
            InputError: as `run`.
        """
        return [Assigned(cell.name, self.run(cell), self.folder_of(cell)) for cell in cells]

    def encoders(self, task: str) -> Path:
        """The folder of the encoders that the study trains for a task."""
        return inside(self.folder, "encoders", slug(task))

    def data(self, task: str, number: int = 0) -> Path:
        """The folder of a data set that the study collects for a task, one of several or alone."""
        several = self.study.data is not None and self.study.data.sets > 1
        return inside(self.folder, "data", slug(task), *([f"set-{number}"] if several else ()))

    def check_folder(self) -> None:
        """Check that the folder is free, or holds this study.

        Raises:
            InputError: it holds another; only tasks, algorithms, representations and seeds may
                change, of a registered study only seeds be added.
        """
        if self.registration and (differing := self.registration.differences(self.study)):
            raise InputError(
                f"{self.folder} holds the study registered on {self.registration.date[:10]}, and "
                f"its file was changed: {differing}; put it back, or choose another --out"
            )
        if (there := read_plan(self.folder)) and (differing := _differing(there.study, self.study)):
            raise InputError(
                f"{self.folder} holds another study: {differing}; choose another --out"
            )

    def begin(self) -> None:
        """Make the folder, and write what the study is if it is new.

        Raises:
            InputError: as `check_folder`.
        """
        self.check_folder()
        if not exists(self.folder / STUDY):
            self.write()

    def write(self) -> None:
        """Make the folder, and write what the study is.

        Raises:
            InputError: as `check_folder`.
        """
        make_folder(self.folder)
        self.check_folder()
        self.study.write(self.folder / STUDY)

    @property
    def has_begun(self) -> bool:
        """Whether it has runs, at whatever step."""
        return any((self.folder / "runs").glob("**/*.*"))

    def register(self) -> Registration:
        """Write down what is going to be run; what is registered already stays as it is.

        Raises:
            InputError: there are runs already, or an encoder is missing.
        """
        if self.registration is None:
            if self.has_begun:
                raise InputError(
                    f"{self.folder} has runs: a study is registered before its first run"
                )
            self.registration = Registration.of(self.study, self.fingerprints)
            self.registration.write(self.folder / REGISTRATION)
        return self.registration


def _differing(there: Study, study: Study) -> str:
    """What differs of two studies besides their grids; empty if nothing does.

    A learner that only one of them has is part of its grid.
    """
    of_one = {f"algorithms.{name}" for name in there.learners.keys() ^ study.learners.keys()}
    before, now = (
        {name: value for name, value in each.flat().items() if name not in of_one.union(_GRID)}
        for each in (there, study)
    )
    return differences(before, now)


def read_plan(folder: Path) -> Plan | None:
    """The study in a folder; None if there is none, but at most runs.

    Raises:
        InputError: its file is damaged, or of another jbrep.
    """
    path = folder / STUDY
    return Plan(read_document(path, Study), folder) if exists(path) else None
