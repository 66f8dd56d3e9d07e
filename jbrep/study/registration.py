"""A study's plan, written down before its first run: what a report holds its runs against."""

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from jbrep.errors import DamageError, InputError, differences
from jbrep.records.commit import CHANGES, commits, in_work_tree, is_committed
from jbrep.records.document import Document, document_from, parse_json
from jbrep.records.record import Version, from_plain, to_plain
from jbrep.records.storage import exists, read_file
from jbrep.rl.files import RunRecord
from jbrep.rl.training import packages
from jbrep.study.config import Study

REGISTRATION = "registration.json"
_SEAL = "sha256"


class Registration(Document, frozen=True, kw_only=True, omit_defaults=True):
    """registration.json, beside a study's file and in its folder."""

    format = "jbrep registration"
    format_version = 3

    study: dict[str, Any]  # as it was written
    encoders: dict[str, str]  # SHA-256 of those that are there beforehand, by the name of the run
    policies: dict[str, str] = {}  # SHA-256 of those that collect data, by file, see `Plan`
    data: dict[str, str] = {}  # fingerprints of those that are there beforehand, by folder
    date: str  # ISO 8601, in UTC
    versions: dict[Version, Version]  # by package
    commits: dict[str, str]
    committed: bool = True  # before the first run; False where no git would have it

    def check(self) -> None:
        """As for `Record`: check that a study was registered."""
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

    @classmethod
    def of(cls, study: Study, **beforehand: Any) -> "Registration":
        """The registration of a study, now.

        Args:
            study: its settings.
            beforehand: encoders, policies and data that are there, and committed.
        """
        return cls(
            study=to_plain(study),
            **beforehand,
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            versions=packages(),
            commits=dict(commits()),
        )

    def differences(self, study: Study) -> str:
        """How a study differs from the registered one, but for its title and added seeds."""
        kept = [seed for seed in study.seeds if seed in self.registered.seeds]
        now = {**study.flat(), "seeds": kept, "title": self.registered.title}
        return differences(self.registered.flat(), now)

    def deviations(self, study: Study, runs: Collection[RunRecord]) -> list[str]:
        """How what ran differs from what was registered, in sentences.

        Args:
            study: its settings now.
            runs: all that have ended.
        """
        found = [] if self.committed else ["its registration is in no commit"]
        if differing := self.differences(study):
            found.append(f"settings differ: {differing}")
        if added := [seed for seed in study.seeds if seed not in self.registered.seeds]:
            found.append(f"seeds were added, whose runs are exploratory: {_listed(added)}")
        if strays := [run for run in runs if run.settings.registration != self.sha256]:
            found.append(f"{len(strays)} of its runs weren't made under this registration")
        used = ((run.settings.name, run.settings.encoder) for run in runs)
        if other := [name for name, each in used if self.encoders.get(name, each) != each]:
            found.append(f"{len(other)} of its runs have other encoders than were registered")
        for name, version in self.versions.items():
            if others := {run.versions.get(name, "none") for run in runs} - {version}:
                found.append(f"{name} was {_listed(sorted(others))}, not {version}")
        return [*found, *self._other_code(run.commits.get("jbrep") for run in runs)]

    def other_data(self, policies: Mapping[str, str], data: Mapping[str, str]) -> list[str]:
        """How policies that collected data, and data that were there, differ, in sentences.

        Args:
            policies: SHA-256 of those that acted, by file.
            data: fingerprints, by folder.
        """
        found = []
        if other := [name for name, each in policies.items() if self.policies.get(name) != each]:
            found.append(f"other policies than were registered collected data: {_listed(other)}")
        if other := [name for name, each in data.items() if self.data.get(name) != each]:
            found.append(f"data are others than were registered: {_listed(other)}")
        return found

    def _other_code(self, ran: Iterable[str | None]) -> list[str]:
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


def read_registration(folder: Path) -> Registration | None:
    """What was registered in a folder; None if nothing was."""
    path = folder / REGISTRATION
    return registration_in(path) if exists(path) else None


def beside(file: Path) -> Path:
    """Where the registration of a study's file is."""
    return file.with_name(f"{file.stem}.{REGISTRATION}")


def find_committed(file: Path, study: Study) -> Registration | None:
    """The registration beside a study's file; None where there is none and needs to be none."""
    path, in_git = beside(file), in_work_tree(file)
    if not exists(path) and not (in_git and study.has_claims):
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


def _listed(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))
