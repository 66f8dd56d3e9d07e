"""What was run, in one file: every run, the settings under each label, the unfinished runs."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from jbrep.encoders import FULL, load
from jbrep.encoders.base import OWN
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError
from jbrep.records.document import Document
from jbrep.records.record import MOST_WHOLE, Record, Sha256, Version, from_plain, pattern, to_plain
from jbrep.records.storage import exists
from jbrep.rl.files import ENCODER, RunRecord
from jbrep.rl.run_settings import RunSettings, SharedSettings
from jbrep.stats.rules import Planned, Rules
from jbrep.stats.runs import in_order
from jbrep.studies.config import Study
from jbrep.studies.plan import REGISTRATION, Plan, read_plan

RECORD = "runs.json"
EACH_ITS_OWN = "runs have different encoders"

Count = Annotated[int, Meta(ge=0, le=MOST_WHOLE)]
Size = Annotated[int, Meta(ge=1, le=MOST_WHOLE)]
Layers = Annotated[tuple[tuple[Size, str], ...], Meta(max_length=100)]  # units and activations


class LabelSettings(SharedSettings, frozen=True, kw_only=True):
    """The settings that all runs of a label share: without the seed and what depends on it."""

    encoder: Annotated[
        str, pattern(f"^([0-9a-f]{{64}}|{EACH_ITS_OWN})$", f"a SHA-256, or {EACH_ITS_OWN}")
    ]
    begin_from: str | None = msgspec.field(name="from")

    @classmethod
    def of(cls, run: RunSettings) -> "LabelSettings":
        """Those of a run."""
        return cls(
            **{name: getattr(run, name) for name in SharedSettings.__struct_fields__},
            encoder=run.encoder if run.encoder_seed is None else EACH_ITS_OWN,
            begin_from=None if run.begin_from is None else "another run's policy",
        )


class EncoderFacts(Record, frozen=True, kw_only=True):
    """What is known of the encoders of a label, as far as they are alike."""

    name: str
    kind: str
    size: Size  # of the observation
    latent_size: Count  # 0 if they differ
    encoder: Layers = ()  # none of a user's own encoder
    decoder: Layers = ()
    training: Mapping[str, Any] = {}  # settings
    data: Mapping[str, Any] = {}  # that it was trained on
    metrics: Mapping[str, Any] = {}  # of the training

    @classmethod
    def of(cls, folder: Path, run: RunRecord) -> "EncoderFacts":
        """Those of a run's encoder; of code, its sizes alone."""
        if not exists(folder / ENCODER):
            return cls(
                name=run.settings.encoder_code or "an object in Python",
                kind=OWN,
                size=run.settings.environment.size,
                latent_size=run.latent_size,
            )
        encoder = load(folder / ENCODER)
        return cls(
            **{name: getattr(encoder, name) for name in ("name", "kind", "size", "latent_size")},
            encoder=tuple((layer.units, layer.activation) for layer in encoder.encoder),
            decoder=tuple((layer.units, layer.activation) for layer in encoder.decoder),
            **{name: getattr(encoder.header, name) for name in ("training", "data", "metrics")},
        )


class Label(Record, frozen=True, kw_only=True):
    """What the runs of a label share."""

    settings: LabelSettings
    encoder: EncoderFacts

    @classmethod
    def of(cls, runs: Mapping[Path, RunRecord]) -> "Label":
        """That of runs by folder; the settings are those of the first."""
        settings = LabelSettings.of(next(iter(runs.values())).settings)
        folders = list(runs) if settings.encoder == EACH_ITS_OWN else list(runs)[:1]
        first, *others = (to_plain(EncoderFacts.of(each, runs[each])) for each in folders)
        common = {name: _common(first[name], [each[name] for each in others]) for name in first}
        return cls(settings=settings, encoder=EncoderFacts(**common))


def _common(value: Any, others: Sequence[Any]) -> Any:
    """A value if the others are equal; of a dict the items that they have, too; else nothing."""
    if isinstance(value, dict):
        return {n: v for n, v in value.items() if all(n in o and o[n] == v for o in others)}
    return value if all(each == value for each in others) else type(value)()


class RunFacts(Record, frozen=True, kw_only=True):
    """A run that has finished or failed."""

    label: str
    seed: Count
    encoder: Sha256
    encoder_seed: Count | None  # that the encoder was made with, if each run has its own
    status: Literal["finished", "failed"]
    reason: str | None  # why it failed
    steps: Count
    seconds: Annotated[float, Meta(ge=0)]
    differs: dict[str, Any] = msgspec.field(default_factory=dict)  # settings other than its label's

    @classmethod
    def of(cls, run: RunRecord, shared: LabelSettings) -> "RunFacts":
        """What is told of a run besides the settings of its label."""
        own, usual = to_plain(LabelSettings.of(run.settings)), to_plain(shared)
        return cls(
            label=run.settings.label,
            **{n: getattr(run.settings, n) for n in ("seed", "encoder", "encoder_seed")},
            **{n: getattr(run, n) for n in ("status", "reason", "steps", "seconds")},
            differs={name: value for name, value in own.items() if value != usual[name]},
        )


class RegistrationFacts(Record, frozen=True, kw_only=True):
    """Of a study that was registered."""

    sha256: Sha256
    date: str  # ISO 8601, in UTC
    deviations: list[str]  # in sentences
    seeds: tuple[int, ...] = ()  # of the runs that its verdicts count; others are exploratory


class RunsRecord(Document, frozen=True, kw_only=True):
    """runs.json: the runs that have ended, the settings under each label, the unfinished runs."""

    format = "jbrep runs"
    format_version = 5
    indent = 1

    study: Study | None  # None for runs without one
    registration: RegistrationFacts | None
    missing: dict[str, Count]  # unfinished runs: training steps done
    tables: dict[str, Sha256]  # of the files beside it
    versions: list[dict[Version, Version]]  # by package
    processors: list[str]
    labels: dict[str, Label]
    runs: list[RunFacts]

    def check(self) -> None:
        if not self.runs:
            raise InputError("it has no finished run")
        if "jbrep" not in (*self.versions, {})[0]:
            raise InputError("the version of jbrep is missing")
        if unknown := [run.label for run in self.runs if run.label not in self.labels]:
            raise InputError(f"settings of {unknown[0]} are missing")
        for run in self.runs:
            self.settings_of(run)

    @property
    def baseline(self) -> str:
        """The representation that the others are compared with."""
        if self.study:
            return self.study.baseline
        return Rules().baseline_of(each.settings.representation for each in self.labels.values())

    @property
    def planned(self) -> Planned:
        """What is compared, and what gets verdicts: only what was registered."""
        if self.study and self.registration:
            return replace(self.study.planned, seeds=self.registration.seeds)
        return Planned(Rules(baseline=self.baseline))

    @property
    def tasks(self) -> dict[str, Task]:
        """The tasks of the runs by their names."""
        settings = (each.settings for each in self.labels.values())
        return {each.task: each.environment for each in settings}

    def draws_of(self, learner: str) -> Mapping[str, tuple[Any, ...]]:
        """The values of settings, one of which each seed of the study draws, of a learner."""
        study = self.study
        return study.learner(learner).draws if study and learner in study.algorithms else {}

    def settings_of(self, run: RunFacts) -> LabelSettings:
        """The settings of a run, without its seed and what depends on it."""
        shared = self.labels[run.label].settings
        if not run.differs:
            return shared
        return from_plain({**to_plain(shared), **run.differs}, LabelSettings)

    def with_table(self, name: str, sha256: str) -> "RunsRecord":
        """The same beside another table."""
        return self.replace(tables={**self.tables, name: sha256})

    @classmethod
    def of(cls, folder: Path, ended: Mapping[Path, RunRecord]) -> "RunsRecord":
        """What was run, as yet without tables.

        Args:
            folder: of a study, or any folder with runs below it.
            ended: the runs that have finished or failed, by folder.
        """
        order = in_order((run.settings.representation for run in ended.values()), FULL)

        def place(run: RunRecord) -> tuple[Any, ...]:
            own = run.settings
            return own.task, own.learner, order.index(own.representation), own.seed

        by_label: dict[str, dict[Path, RunRecord]] = {}
        for each, run in sorted(ended.items(), key=lambda item: place(item[1])):
            by_label.setdefault(run.settings.label, {})[each] = run
        labels = {label: Label.of(runs) for label, runs in by_label.items()}
        runs = [run for of_label in by_label.values() for run in of_label.values()]
        plan = read_plan(folder)
        versions = [run.versions for run in runs]
        return cls(
            study=plan.study if plan else None,
            registration=_registered(plan, runs) if plan else None,
            missing={cell.name: plan.progress(cell) for cell in plan.unfinished} if plan else {},
            tables={},
            versions=[*{frozenset(each.items()): dict(each) for each in versions}.values()],
            processors=[*dict.fromkeys(run.cpu for run in runs)],
            labels=labels,
            runs=[RunFacts.of(run, labels[run.settings.label].settings) for run in runs],
        )


def _registered(plan: Plan, runs: Collection[RunRecord]) -> RegistrationFacts | None:
    """When a study was registered, and how what ran differs from that; None if it wasn't."""
    if (found := plan.registration) is None:
        if any(run.settings.registration for run in runs):
            raise DamageError(
                f"{plan.folder / REGISTRATION} is missing, and runs were made under it: copy the "
                "registration beside the study's file there"
            )
        return None
    return RegistrationFacts(
        sha256=found.sha256,
        date=found.date,
        deviations=plan.deviations(runs),
        seeds=found.registered.seeds,
    )
