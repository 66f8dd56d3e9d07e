"""A study's plan, written down before its first run: what a report holds its runs against."""

from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from jbrep.errors import differences
from jbrep.records.commit import CHANGES, commits
from jbrep.records.document import Document, read_document
from jbrep.records.record import Version, from_plain, to_plain
from jbrep.records.storage import exists
from jbrep.rl.files import RunRecord
from jbrep.rl.job import packages
from jbrep.study.config import Study

REGISTRATION = "registration.json"


class Registration(Document, frozen=True, kw_only=True):
    """registration.json."""

    format = "jbrep registration"
    format_version = 1

    study: dict[str, Any]  # as it was written
    encoders: dict[str, str]  # SHA-256 by the name of the run; older ones: of those that were there
    date: str  # ISO 8601, in UTC
    versions: dict[Version, Version]  # by package
    commits: dict[str, str]

    def check(self) -> None:
        """As for `Record`: check that a study was registered."""
        _ = self.registered

    @cached_property
    def registered(self) -> Study:
        """The study; verdicts that don't say what gains are counted over count over standing still.

        All did when the first studies were registered.
        """
        study = from_plain(self.study, Study, "study")
        if not study.verdicts.primary or "gains_over" in self.study["verdicts"]:
            return study
        return study.replace(verdicts=study.verdicts.replace(gains_over="still"))

    @classmethod
    def of(cls, study: Study, encoders: Mapping[str, str]) -> "Registration":
        """The registration of a study, now.

        Args:
            study: its settings.
            encoders: their SHA-256, by the name of the run.
        """
        return cls(
            study=_explicit(study),
            encoders=dict(encoders),
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
        found = []
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


def read_registration(folder: Path) -> Registration | None:
    """What was registered in a folder; None if nothing was.

    Raises:
        DamageError: the file was changed since, or is damaged.
        InputError: it is of another jbrep.
    """
    path = folder / REGISTRATION
    return read_document(path, Registration) if exists(path) else None


def _explicit(study: Study) -> dict[str, Any]:
    """A study as it is registered: its verdicts say what gains are counted over."""
    plain = to_plain(study)
    if study.verdicts.primary:
        plain["verdicts"]["gains_over"] = study.verdicts.gains_over
    return plain


def _listed(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))
