"""A study's folder: what is where, and which runs there are."""

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from jbrep.encoders.file import SUFFIX
from jbrep.errors import InputError, differences
from jbrep.files.storage import exists, make_folder, read_regular, write_whole
from jbrep.rl import Run
from jbrep.rl.files import RUN
from jbrep.rl.run import plain
from jbrep.study.config import Learner, Representation, Study, as_study

STUDY = "study.json"
_GRID = ("tasks", "algorithms", "representations", "seeds")  # may grow
_MAX_BYTES = 1 << 24


@dataclass(frozen=True)
class Cell:
    """One run of the grid."""

    task: str
    learner: Learner
    representation: Representation
    seed: int

    @property
    def name(self) -> str:
        """Where it is below the study's folder of runs."""
        words = (self.task, self.learner.name, self.representation.name)
        return "/".join((*words, f"seed-{self.seed}"))


class Plan:
    """A study in its folder.

    Below it are `runs`, and `data` and `encoders` where the study makes its own.
    """

    def __init__(self, study: Study, folder: Path):
        self.study = study
        self.folder = folder.absolute()  # workers may stand elsewhere

    @cached_property
    def representations(self) -> tuple[Representation, ...]:
        """How agents see the state."""
        study = self.study
        return tuple(Representation.of(name, study.training) for name in study.representations)

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All runs, whole seeds first."""
        study = self.study
        return tuple(
            Cell(task, Learner.of(algorithm), representation, seed)
            for seed in study.seeds
            for task in study.tasks
            for algorithm in study.algorithms
            for representation in self.representations
        )

    def folder_of(self, cell: Cell) -> Path:
        """A run's folder."""
        return self.folder / "runs" / cell.name

    def is_over(self, cell: Cell) -> bool:
        """Whether a run has come to its end, be it a failure."""
        return exists(self.folder_of(cell) / RUN)

    def run(self, cell: Cell) -> Run:
        """What is to be trained."""
        study = self.study
        return Run(
            task=cell.task,
            algorithm=cell.learner.algorithm,
            preset=cell.learner.preset,
            encoder=self._encoder(cell),
            seed=cell.seed,
            steps=study.steps,
            evaluate_every=study.evaluate_every,
            evaluation_episodes=study.evaluation_episodes,
        )

    def encoders(self, task: str) -> Path:
        """The folder of the encoders that the study makes for a task."""
        return self.folder / "encoders" / task

    def _encoder(self, cell: Cell) -> str:
        name = cell.representation.encoder
        if self.study.data is None:
            return name
        return str(self.encoders(cell.task) / f"{name}{SUFFIX}")

    def begin(self) -> None:
        """Make the folder, and write down there what the study is.

        Raises:
            InputError: the folder is of another study: other tasks, algorithms, representations
                and seeds may come to one, all else stays.
        """
        make_folder(self.folder)
        path = self.folder / STUDY
        wanted = plain(asdict(self.study))
        if exists(path):
            shared = {name: value for name, value in wanted.items() if name not in _GRID}
            if differing := differences(_read(path), shared):
                raise InputError(
                    f"{self.folder} holds another study: {differing}; choose another --out"
                )
        write_whole(path, (json.dumps(wanted, indent=2) + "\n").encode())


def read_plan(folder: Path) -> Plan | None:
    """The study that a folder is of; None if it holds runs alone.

    Raises:
        InputError: what says so is damaged.
    """
    path = folder / STUDY
    if not exists(path):
        return None
    given = {name: value for name, value in _read(path).items() if value is not None}
    try:
        return Plan(as_study(given), folder)
    except InputError as error:
        raise InputError(f"{path} is damaged, or of a newer jbrep: {error}") from None


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(read_regular(path, _MAX_BYTES)))
    except (OSError, ValueError, TypeError, RecursionError):
        raise InputError(f"{path} is damaged, or not of a study: choose another --out") from None
