"""A study's folder: where its files are, and which runs it has."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST, read_manifest
from jbrep.dataset.settings import TRAINED, parts_of
from jbrep.envs.description import describe
from jbrep.envs.task import Task
from jbrep.errors import InputError, differences
from jbrep.records.commit import in_work_tree
from jbrep.records.document import read_document
from jbrep.records.record import to_plain
from jbrep.records.storage import exists, make_folder
from jbrep.rl import Run
from jbrep.rl.files import RUN, RunRecord
from jbrep.rl.learner import Learner
from jbrep.study.config import Study
from jbrep.study.registration import REGISTRATION, Registration, read_registration
from jbrep.study.representations import ByName, Representation
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
_GRID_TABLES = "algorithms.", "data."


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
    def name(self) -> str:
        """Its folder below the study's folder of runs."""
        parts = (slug(self.task), self.learner.name, self.representation.name, f"seed-{self.seed}")
        return "/".join(parts)


class Plan:
    """A study in its folder, which holds `runs`, and `data` and `encoders` if the study makes them.

    Args:
        study: what to run.
        folder: of this study alone.
        file: the study's, if it has one; its registration is beside it.
    """

    def __init__(self, study: Study, folder: str | Path, file: Path | None = None):
        self.study, self.file = study, file
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
    def in_git(self) -> bool:
        """Whether the study's file, and so what is registered beside it, can be committed."""
        return self.file is not None and in_work_tree(self.file)

    @property
    def device(self) -> str:
        """What gradient steps are taken on."""
        return str(get_device(self.study.device).type)

    def folder_of(self, cell: Cell) -> Path:
        """A run's folder."""
        return self.folder / "runs" / cell.name

    def has_ended(self, cell: Cell) -> bool:
        """Whether a run has finished or failed."""
        return exists(self.folder_of(cell) / RUN)

    @property
    def unfinished(self) -> list[Cell]:
        """The runs that have neither finished nor failed."""
        return [cell for cell in self.cells if not self.has_ended(cell)]

    def task(self, name: str) -> Task:
        """A task with the study's arguments, time limit and domain."""
        study = self.study
        return describe(name, study.environment, study.episode_steps, domain=study.domain or {})

    def run(self, cell: Cell) -> Run:
        """What to train."""
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
        """The SHA-256 of encoders that the study doesn't make, by the name of the run."""
        return {
            cell.name: self.run(cell).find_encoder().fingerprint
            for cell in self.cells
            if not (self.study.data and isinstance(cell.representation, ByName))
        }

    @property
    def policies(self) -> dict[str, str]:
        """SHA-256 of the files of policies that acted in its data sets, by their paths there."""
        manifests = {
            path.parent.relative_to(self.folder): read_manifest(path.parent)
            for path in sorted((self.folder / "data").rglob(MANIFEST))
        }
        return {
            f"{folder}/{part['file']}": part["sha256"]
            for folder, manifest in manifests.items()
            for part in parts_of(manifest.settings.policy)
            if part["kind"] == TRAINED
        }

    @property
    def existing_data(self) -> dict[str, str]:
        """The fingerprints of data sets that the study doesn't make, by their folders."""
        folders = {
            data.existing(task)
            for data in self.study.named_data.values()
            if data.folder
            for task in self.study.tasks
        }
        there = sorted(folder for folder in folders if exists(folder / MANIFEST))
        return {str(folder): Dataset(folder).fingerprint for folder in there}

    def deviations(self, runs: Collection[RunRecord]) -> list[str]:
        """How what ran differs from what was registered, in sentences; none if nothing was."""
        if self.registration is None:
            return []
        return [
            *self.registration.deviations(self.study, runs),
            *self.registration.other_data(self.policies, self.existing_data),
        ]

    def assigned(self, cell: Cell) -> Assigned:
        """A run for a worker."""
        return Assigned(cell.name, self.run(cell), self.folder_of(cell))

    def encoders(self, task: str) -> Path:
        """The folder of the encoders that the study trains for a task."""
        return self.folder / "encoders" / slug(task)

    def data(self, task: str, number: int = 0, name: str = "") -> Path:
        """The folder of a data set that the study collects for a task, one of several or alone.

        Args:
            task: its name.
            number: of the data set.
            name: of the data; empty for those of the only table.
        """
        several = name in self.study.named_data and self.study.sets(name) > 1
        of_set = [f"set-{number}"] if several else []
        return self.folder.joinpath("data", *([name] if name else []), slug(task), *of_set)

    def check_folder(self) -> None:
        """Check that the folder is free, or holds this study."""
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
        """Make the folder, and write what the study is if it is new."""
        self.check_folder()
        if not exists(self.folder / STUDY):
            self.write()

    def write(self) -> None:
        """Make the folder, and write what the study is."""
        make_folder(self.folder)
        self.check_folder()
        self.study.write(self.folder / STUDY)

    @property
    def has_begun(self) -> bool:
        """Whether it has runs, at whatever step."""
        return any((self.folder / "runs").glob("**/*.*"))

    def register(self, registration: Registration) -> None:
        """Write down what is going to be run."""
        if self.registration is None:
            self.check_new()
            self.registration = registration
            self.registration.write(self.folder / REGISTRATION)
        elif self.registration.sha256 != registration.sha256:
            raise InputError(
                f"{self.folder} holds the study as it was registered otherwise, on "
                f"{self.registration.date[:10]}: choose another --out"
            )

    def check_new(self) -> None:
        """Check that there are no runs."""
        if self.has_begun:
            raise InputError(f"{self.folder} has runs: a study is registered before its first run")


def _differing(there: Study, study: Study) -> str:
    """What differs of two studies besides their grids; empty if nothing does.

    A learner that only one of them has is part of its grid, and so are data with a name.
    """
    before, now = there.flat(), study.flat()
    of_one = {name for name in before.keys() ^ now.keys() if name.startswith(_GRID_TABLES)}
    kept = [
        {name: value for name, value in each.items() if name not in of_one.union(_GRID)}
        for each in (before, now)
    ]
    return differences(*kept)


def read_plan(folder: Path) -> Plan | None:
    """The study in a folder; None if there is none, but at most runs."""
    path = folder / STUDY
    return Plan(read_document(path, Study), folder) if exists(path) else None
