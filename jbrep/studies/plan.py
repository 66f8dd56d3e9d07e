"""A study in its folder: where its files are, which runs it has, and what was registered."""

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST, read_manifest
from jbrep.dataset.settings import TRAINED, parts_of
from jbrep.envs.names import Known, environment_versions, file_digest
from jbrep.errors import DamageError, InputError, differences
from jbrep.play.sources import frozen_file
from jbrep.records.commit import CHANGES, commits, in_work_tree, is_committed
from jbrep.records.document import Document, document_from, parse_json, read_document
from jbrep.records.record import Version, from_plain, to_plain
from jbrep.records.storage import exists, make_folder, read_file
from jbrep.rl import Run
from jbrep.rl.files import RUN, RunRecord
from jbrep.rl.learner import Learner
from jbrep.rl.training import packages
from jbrep.studies.config import Study
from jbrep.studies.representations import ByName, Representation
from jbrep.text import slug
from jbrep.training.trainer import get_device

STUDY = "study.json"
REGISTRATION = "registration.json"
PROGRESS = "progress"  # of a run under way: its steps
_SEAL = "sha256"
# may change
_GRID = "tasks", "algorithms", "representations", "seeds", "evaluate", "evaluations", "title"
_GRID_TABLES = "algorithms.", "data.", "tasks."


class Registration(Document, frozen=True, kw_only=True, omit_defaults=True):
    """registration.json, beside a study's file and in its folder."""

    format = "jbrep registration"
    format_version = 3

    study: dict[str, Any]  # as it was written
    encoders: dict[str, str]  # SHA-256 of those that are there beforehand, by the name of the run
    policies: dict[str, str] = {}  # SHA-256 by file, see `Plan`
    data: dict[str, str] = {}  # fingerprints of those that are there beforehand, by folder
    date: str  # ISO 8601, in UTC
    versions: dict[Version, Version]  # by package
    commits: dict[str, str]
    committed: bool = True  # before the first run; False where no git would have it

    def check(self) -> None:
        _ = self.registered

    @cached_property
    def registered(self) -> Study:
        """The study."""
        return from_plain(self.study, Study, "study")

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of its fields, as canonical JSON: its file has it, so that changes are seen."""
        return seal(to_plain(self))

    def as_json(self) -> dict[str, Any]:
        return {**super().as_json(), _SEAL: self.sha256}

    def differences(self, study: Study) -> str:
        """How a study differs from the registered one, but for its title and added seeds."""
        kept = [seed for seed in study.seeds if seed in self.registered.seeds]
        now = {**study.flat(), "seeds": kept, "title": self.registered.title}
        return differences(self.registered.flat(), now)

    def deviations(
        self,
        study: Study,
        runs: Collection[RunRecord],
        policies: Mapping[str, str],
        data: Mapping[str, str],
    ) -> list[str]:
        """How what ran differs from what was registered, in sentences.

        Args:
            study: its settings now.
            runs: all that have ended.
            policies: SHA-256 of those that collected data or score 1, by file.
            data: fingerprints of those that the study doesn't make, by folder.
        """
        found = [] if self.committed else ["its registration is in no commit"]
        if differing := self.differences(study):
            found.append(f"settings differ: {differing}")
        if added := [seed for seed in study.seeds if seed not in self.registered.seeds]:
            found.append(f"seeds were added, whose runs are exploratory: {_listed(added)}")
        if strays := [run for run in runs if run.settings.registration != self.sha256]:
            found.append(f"{len(strays)} of its runs weren't made under this registration")
        used = {run.settings.name: run.settings.encoder for run in runs}
        if other := _others(used, used | self.encoders):
            found.append(f"{len(other)} of its runs have other encoders than were registered")
        for name, version in self.versions.items():  # some are of one task's environment alone
            if others := {run.versions.get(name, version) for run in runs} - {version}:
                found.append(f"{name} was {_listed(others)}, not {version}")
        found += self._other_code({run.commits.get("jbrep") for run in runs})
        if other := _others(policies, self.policies):
            found.append(f"policies are others than were registered: {_listed(other)}")
        if other := _others(data, self.data):
            found.append(f"data are others than were registered: {_listed(other)}")
        if gone := self.data.keys() - data.keys():
            found.append(f"data aren't there to be compared with those registered: {_listed(gone)}")
        return found

    def _other_code(self, ran: Set[str | None]) -> list[str]:
        """How the code that ran, by its commits, differs from that which was registered."""
        registered = self.commits.get("jbrep")
        every = {registered, *ran}
        if any(each.endswith(CHANGES) for each in every if each):
            return ["jbrep's code had changes that are in no commit, so it can't be compared"]
        if every == {registered}:
            return []
        if None in every:
            return ["some of jbrep's code was of no known commit, so it can't be compared"]
        return ["some runs were made by other commits of jbrep's code"]


def _others(hashes: Mapping[str, str], registered: Mapping[str, str]) -> list[str]:
    """The names whose hashes aren't those that were registered."""
    return [name for name, each in hashes.items() if registered.get(name) != each]


def seal(fields: Mapping[str, Any]) -> str:
    """SHA-256 of plain JSON in its canonical form."""
    canonical = json.dumps(fields, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def registration_in(path: Path) -> Registration:
    """What a file says.

    Raises:
        DamageError: the file was changed since it was written, or is damaged.
    """
    given = parse_json(read_file(path), path, Registration.format)
    stated = given.pop(_SEAL, None)
    found = document_from(given, path, Registration)
    if stated != found.sha256:
        raise DamageError(
            f"{path} was changed after it was written, or is damaged: its checksum doesn't match"
        )
    return found


def beside(file: Path) -> Path:
    """Where the registration of a study's file is."""
    return file.with_name(f"{file.stem}.{REGISTRATION}")


def find_committed(file: Path, study: Study) -> Registration | None:
    """The registration beside a study's file; None where there is none and needs to be none."""
    path, in_git = beside(file), in_work_tree(file)
    if not exists(path) and not (in_git and study.verdicts.claims):
        return None
    if in_git and not is_committed(path):
        state = "isn't as in the last commit" if exists(path) else "is missing"
        raise InputError(
            f"{path} {state}: register the study with --register, commit that file, then run it"
        )
    found = registration_in(path)
    if differing := found.differences(study):
        raise InputError(
            f"{path} is of another study than {file}: {differing}; register it with --register, "
            "commit that file, then run it"
        )
    return found


def _listed(values: Iterable[Any]) -> str:
    return ", ".join(map(str, sorted(values)))


class Assigned(NamedTuple):
    """A run for a worker."""

    name: str
    run: Run
    folder: Path  # of this run alone


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
        path = self.folder / REGISTRATION
        return registration_in(path) if exists(path) else None

    @property
    def in_git(self) -> bool:
        """Whether the study's file, and so what is registered beside it, can be committed."""
        return self.file is not None and in_work_tree(self.file)

    @property
    def device(self) -> str:
        """What gradient steps are taken on."""
        return str(get_device(self.study.device).type)

    @property
    def known(self) -> Known:
        """What the processes of runs import and register first."""
        return Known.of(map(self.study.task, self.study.tasks))

    def folder_of(self, cell: Cell) -> Path:
        """A run's folder."""
        return self.folder / "runs" / cell.name

    def progress(self, cell: Cell) -> int:
        """The steps that a run has done."""
        with suppress(InputError, ValueError):
            return int(read_file(self.folder_of(cell) / PROGRESS))
        return 0

    @property
    def unfinished(self) -> list[Cell]:
        """The runs that have neither finished nor failed."""
        return [cell for cell in self.cells if not exists(self.folder_of(cell) / RUN)]

    def run(self, cell: Cell) -> Run:
        """What to train."""
        made = self.encoders(cell.task) if self.study.data else None
        return Run(
            task=self.study.task(cell.task),
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
            f"{cell.label}/seed-{cell.seed}": self.run(cell).find_encoder().fingerprint
            for cell in self.cells
            if not (self.study.data and isinstance(cell.representation, ByName))
        }

    @property
    def reference(self) -> dict[str, str]:
        """SHA-256 of the file of the policy that scores 1, by its path, if it is in a file."""
        named = self.study.verdicts.policy
        path = frozen_file(named) if named else None
        return {str(path): file_digest(path)} if path else {}

    @property
    def policies(self) -> dict[str, str]:
        """SHA-256 of the files of policies that acted in its data sets or score 1, by their paths.

        Those of data sets are within the study's folder.
        """
        manifests = {
            path.parent.relative_to(self.folder): read_manifest(path.parent)
            for path in sorted((self.folder / "data").rglob(MANIFEST))
        }
        acted = {
            f"{folder}/{part['file']}": part["sha256"]
            for folder, manifest in manifests.items()
            for part in parts_of(manifest.settings.policy)
            if part["kind"] == TRAINED
        }
        return acted | self.reference

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
        return self.registration.deviations(self.study, runs, self.policies, self.existing_data)

    def assigned(self, cell: Cell) -> Assigned:
        """A run for a worker."""
        return Assigned(cell.name, self.run(cell), self.folder_of(cell))

    def encoders(self, task: str) -> Path:
        """The folder of the encoders that the study trains for a task."""
        return self.folder / "encoders" / slug(task)

    def data(self, task: str, number: int, name: str) -> Path:
        """The folder of a data set that the study collects for a task, one of several or alone.

        Args:
            task: its name.
            number: of the data set.
            name: of the data; empty for those of the only table.
        """
        of_set = [f"set-{number}"] if self.study.sets(name) > 1 else []
        return self.folder.joinpath("data", *([name] if name else []), slug(task), *of_set)

    def check_folder(self) -> None:
        """Check that the folder is free, or holds this study."""
        if self.registration and (differing := self.registration.differences(self.study)):
            raise InputError(
                f"{self.folder} holds the study registered on {self.registration.date[:10]}, and "
                f"its file was changed: {differing}; put it back, or choose another `out`"
            )
        if (there := read_plan(self.folder)) and (differing := _differing(there.study, self.study)):
            raise InputError(
                f"{self.folder} holds another study: {differing}; choose another `out`"
            )

    def write(self) -> None:
        """Make the folder, and write what the study is."""
        make_folder(self.folder)
        self.check_folder()
        self.study.write(self.folder / STUDY)

    @property
    def has_begun(self) -> bool:
        """Whether it has runs, at whatever step."""
        return any((self.folder / "runs").glob("**/*.*"))

    def to_register(self, policies: dict[str, str]) -> Registration:
        """What is going to be run, as it is now, and the policies that will collect data."""
        used = [environment_versions(self.study.task(name)).items() for name in self.study.tasks]
        return Registration(
            study=to_plain(self.study),
            encoders=self.fingerprints,
            policies=policies,
            data=self.existing_data,
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            versions=packages() | dict(chain(*used)),
            commits=dict(commits()),
            committed=self.in_git,
        )

    def register(self, registration: Registration) -> None:
        """Write down what is going to be run."""
        if self.registration is None:
            self.check_new()
            self.registration = registration
            self.registration.write(self.folder / REGISTRATION)
        elif self.registration.sha256 != registration.sha256:
            raise InputError(
                f"{self.folder} was registered on {self.registration.date[:10]} with another "
                "registration: choose another `out`"
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
    """The study in a folder; None if there is none, even if there are runs."""
    path = folder / STUDY
    return Plan(read_document(path, Study), folder) if exists(path) else None
