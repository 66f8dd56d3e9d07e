"""What was run, in one file: every run, the settings under each label, the unfinished runs."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from jbrep.coordinates import OBSERVATION
from jbrep.dataset.scaling import EXTREMA
from jbrep.encoders import FULL, load
from jbrep.encoders.base import OWN
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.document import Document
from jbrep.records.record import MOST_WHOLE, Record, Sha256, Version, from_plain, pattern, to_plain
from jbrep.records.storage import exists
from jbrep.rl.files import ENCODER, RunRecord
from jbrep.rl.run_settings import RunSettings, SharedSettings
from jbrep.stats.rules import Planned, Rules
from jbrep.stats.runs import in_order
from jbrep.study.config import Study
from jbrep.study.plan import Plan, read_plan
from jbrep.study.work import read_progress

RECORD = "runs.json"
EACH_ITS_OWN = "runs have different encoders"
_Value = TypeVar("_Value")

Count = Annotated[int, Meta(ge=0, le=MOST_WHOLE)]
Size = Annotated[int, Meta(ge=1, le=MOST_WHOLE)]
Layer = tuple[Size, str]  # units and activation
Layers = Annotated[tuple[Layer, ...], Meta(max_length=100)]


class LabelSettings(SharedSettings, frozen=True, kw_only=True):
    """The settings that all runs of a label share: without the seed and what depends on it."""

    encoder: Annotated[
        str, pattern(f"^([0-9a-f]{{64}}|{EACH_ITS_OWN})$", f"a SHA-256, or {EACH_ITS_OWN}")
    ]
    begin_from: str | None = msgspec.field(name="from")


class ShownFacts(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """What reports show of how an encoder was made; other facts stand beside."""

    noise: float | None = None  # standard deviation of the corruption in training
    scaling: str = EXTREMA  # of the features
    on: str = OBSERVATION  # what is encoded: the observation, or coordinates of it
    keep: tuple[str, ...] = ()  # features that pass around the encoder
    train_rows: Count | None = None
    held_out_mse: float | None = None


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

    def check(self) -> None:
        """As for `Record`: check what reports show."""
        _ = self.shown

    @cached_property
    def shown(self) -> ShownFacts:
        """What reports show of its training, data and metrics."""
        return from_plain({**self.training, **self.data, **self.metrics}, ShownFacts)


class Label(Record, frozen=True, kw_only=True):
    """What the runs of a label share."""

    settings: LabelSettings
    encoder: EncoderFacts


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


class RegistrationFacts(Record, frozen=True, kw_only=True):
    """Of a study that was registered."""

    sha256: Sha256
    date: str  # ISO 8601, in UTC
    deviations: list[str]  # in sentences
    seeds: tuple[int, ...] = ()  # of the runs that its verdicts count; others are exploratory


class RunsRecord(Document, frozen=True, kw_only=True):
    """runs.json."""

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


def runs_record(
    folder: Path, ended: Mapping[Path, RunRecord], tables: Mapping[str, str]
) -> RunsRecord:
    """What was run.

    Args:
        folder: of a study, or any folder with runs below it.
        ended: what run.json says of each run that has finished or failed, by folder.
        tables: SHA-256 of the tables of these runs, by their files' names.
    """
    order = in_order((run.settings.representation for run in ended.values()), FULL)
    by_label: dict[str, dict[Path, RunRecord]] = {}
    for each, run in sorted(ended.items(), key=lambda item: _sort_key(item[1].settings, order)):
        by_label.setdefault(run.settings.label, {})[each] = run
    runs = [run for of_label in by_label.values() for run in of_label.values()]
    labels = {label: _label(of_label) for label, of_label in by_label.items()}
    plan = read_plan(folder)
    unfinished = {each.name: plan.folder_of(each) for each in plan.unfinished} if plan else {}
    return RunsRecord(
        study=plan.study if plan else None,
        registration=_registration(plan, runs) if plan else None,
        missing={name: read_progress(each)[0] for name, each in unfinished.items()},
        tables=dict(tables),
        versions=_distinct(dict(run.versions) for run in runs),
        processors=_distinct(run.cpu for run in runs),
        labels=labels,
        runs=[_run(run, labels[run.settings.label].settings) for run in runs],
    )


def _run(run: RunRecord, of_label: LabelSettings) -> RunFacts:
    """What is told of a run besides the settings of its label."""
    settings, shared = map(to_plain, (_shared_settings(run.settings), of_label))
    return RunFacts(
        label=run.settings.label,
        seed=run.settings.seed,
        encoder=run.settings.encoder,
        encoder_seed=run.settings.encoder_seed,
        status=run.status,
        reason=run.reason,
        steps=run.steps,
        seconds=run.seconds,
        differs={name: value for name, value in settings.items() if value != shared[name]},
    )


def _sort_key(settings: RunSettings, order: list[str]) -> tuple[Any, ...]:
    """By task, algorithm, representation (in the order of tables) and seed."""
    representation = order.index(settings.representation)
    return settings.task, settings.learner, representation, settings.seed


def _shared_settings(settings: RunSettings) -> LabelSettings:
    """The settings that all runs of a label share: without the seed and what depends on it."""
    shared = {name: getattr(settings, name) for name in SharedSettings.__struct_fields__}
    return LabelSettings(
        **shared,
        encoder=settings.encoder if settings.encoder_seed is None else EACH_ITS_OWN,
        begin_from=None if settings.begin_from is None else "another run's policy",
    )


def _label(runs: Mapping[Path, RunRecord]) -> Label:
    """What the runs of a label share, by folder; its settings are those of the first."""
    settings = _shared_settings(next(iter(runs.values())).settings)
    folders = list(runs) if settings.encoder == EACH_ITS_OWN else list(runs)[:1]
    encoder = _common([_encoder(each, runs[each]) for each in folders])
    return Label(settings=settings, encoder=encoder)


def _encoder(folder: Path, run: RunRecord) -> EncoderFacts:
    """What is known of a run's encoder; of a user's own, its sizes alone."""
    settings = run.settings
    if not exists(folder / ENCODER):
        return EncoderFacts(
            name=settings.encoder_code or "an object in Python",
            kind=OWN,
            size=settings.environment.size,
            latent_size=run.latent_size,
        )
    encoder = load(folder / ENCODER)
    return EncoderFacts(
        name=encoder.name,
        kind=encoder.kind,
        size=encoder.size,
        latent_size=encoder.latent_size,
        encoder=tuple((layer.units, layer.activation) for layer in encoder.encoder),
        decoder=tuple((layer.units, layer.activation) for layer in encoder.decoder),
        **{name: getattr(encoder.header, name) for name in ("training", "data", "metrics")},
    )


def _common(encoders: Sequence[EncoderFacts]) -> EncoderFacts:
    """What is the same of all encoders; empty where nothing is."""
    first, *others = map(to_plain, encoders)
    return EncoderFacts(**{n: _shared(v, [o[n] for o in others]) for n, v in first.items()})


def _shared(value: Any, others: Sequence[Any]) -> Any:
    """A value if the others are equal; of a dict the items that they have, too; else nothing."""
    if isinstance(value, dict):
        return {n: v for n, v in value.items() if all(n in o and o[n] == v for o in others)}
    return value if all(each == value for each in others) else type(value)()


def _registration(plan: Plan, runs: Collection[RunRecord]) -> RegistrationFacts | None:
    """When a study was registered, and how what ran differs from that; None if it wasn't."""
    if (found := plan.registration) is None:
        return None
    deviations = plan.deviations(runs)
    return RegistrationFacts(
        sha256=found.sha256,
        date=found.date,
        deviations=deviations,
        seeds=found.registered.seeds,
    )


def _distinct(values: Iterable[_Value]) -> list[_Value]:
    distinct: list[_Value] = []
    for value in values:
        if value not in distinct:
            distinct.append(value)
    return distinct
