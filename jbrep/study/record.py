"""What was run, in one file: every run, the settings under each label, the unfinished runs."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from jbrep.dataset.scaling import EXTREMA
from jbrep.encoders import FULL, load
from jbrep.encoders.base import OWN
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.document import Document
from jbrep.records.record import Record, from_plain, to_plain
from jbrep.records.storage import exists
from jbrep.rl.files import ENCODER
from jbrep.rl.names import base_name
from jbrep.rl.settings import TrainingSettings
from jbrep.stats.runs import in_order
from jbrep.study.config import Study
from jbrep.study.plan import Plan, read_plan
from jbrep.study.registration import deviations
from jbrep.study.work import read_progress

RECORD = "runs.json"
EACH_ITS_OWN = "runs have different encoders"
_Value = TypeVar("_Value")

_MOST = 1 << 53  # of a number: a float holds whole ones exactly
Count = Annotated[int, Meta(ge=0, le=_MOST)]
Size = Annotated[int, Meta(ge=1, le=_MOST)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", title="64 hexadecimal digits")]
Layer = tuple[Size, str]  # units and activation


class LabelSettings(TrainingSettings, frozen=True, kw_only=True):
    """The settings that all runs of a label share: without the seed and what depends on it."""

    task: str
    environment: dict[str, Any]  # the task's description
    algorithm: str
    preset: str
    overrides: dict[str, Any]  # of the preset
    learner: str
    hidden: list[Size] | dict[str, list[Size]]  # units of the agent's layers, or of its networks'
    settings: dict[str, Any]  # of the algorithm
    num_envs: Size
    noise: list[float] | None
    optimizer: dict[str, Any]
    policy: dict[str, Any]
    normalize: bool
    representation: str
    encoder: Annotated[
        str,
        Meta(
            pattern=f"^([0-9a-f]{{64}}|{EACH_ITS_OWN})$",
            title=f"64 hexadecimal digits, or {EACH_ITS_OWN!r}",
        ),
    ]
    encoder_code: str | None  # module:Class, if it is code
    begin_from: str | None = msgspec.field(name="from")

    def check(self) -> None:
        """Check the task's description.

        Raises:
            ValueError: it isn't one.
        """
        from_plain(self.environment, Task)


class ShownFacts(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """What reports show of how an encoder was made; other facts stand beside."""

    noise: float | None = None  # standard deviation of the corruption in training
    scaling: str = EXTREMA  # of the features
    angles: bool = False  # whether each angle is encoded as its sine and cosine
    keep: tuple[str, ...] = ()  # features that pass around the encoder
    train_rows: Count | None = None
    held_out_mse: float | None = None


class EncoderFacts(Record, frozen=True, kw_only=True):
    """What is known of the encoders of a label, as far as they are alike."""

    name: str
    kind: str
    size: Size  # of the observation
    latent_size: Count  # 0 if they differ
    encoder: list[Layer]  # of a user's own encoder, none
    decoder: list[Layer]
    training: dict[str, Any]  # settings
    data: dict[str, Any]  # that it was trained on
    metrics: dict[str, Any]  # of the training

    def check(self) -> None:
        """Check what reports show.

        Raises:
            InputError: a part isn't of its type.
        """
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


class RegistrationFacts(Record, frozen=True, kw_only=True):
    """Of a study that was registered."""

    sha256: Sha256
    date: str  # ISO 8601, in UTC
    deviations: list[str]  # in sentences


class RunsRecord(Document, frozen=True, kw_only=True):
    """runs.json."""

    format = "jbrep runs"
    format_version = 1
    max_bytes = 1 << 28
    indent = 1

    study: Study | None  # None for runs without one
    registration: RegistrationFacts | None
    missing: dict[str, Count]  # unfinished runs: training steps done
    left_out: list[str]  # what has no statistics, and why
    versions: list[dict[str, str]]  # by package
    processors: list[str]
    labels: dict[str, Label]
    runs: list[RunFacts]

    def check(self) -> None:
        """Check that its parts fit together.

        Raises:
            InputError: they don't.
        """
        if not self.runs:
            raise InputError("it has no finished run")
        if "jbrep" not in (*self.versions, {})[0]:
            raise InputError("the version of jbrep is missing")
        if unknown := [run.label for run in self.runs if run.label not in self.labels]:
            raise InputError(f"settings of {unknown[0]} are missing")


def runs_record(
    folder: Path, ended: Mapping[Path, Mapping[str, Any]], left_out: Sequence[str]
) -> RunsRecord:
    """What was run.

    Args:
        folder: of a study, or any folder with runs below it.
        ended: what run.json says of each run that has finished or failed, by folder.
        left_out: what the statistics leave out, in sentences.

    Raises:
        InputError: a file is damaged.
    """
    order = in_order((run["settings"]["representation"] for run in ended.values()), FULL)
    runs = dict(sorted(ended.items(), key=lambda item: _sort_key(item[1]["settings"], order)))
    labels: dict[str, dict[Path, Mapping[str, Any]]] = {}
    for each, run in runs.items():
        labels.setdefault(run_label(run["settings"]), {})[each] = run
    plan = read_plan(folder)
    return RunsRecord(
        study=plan.study if plan else None,
        registration=_registration(plan, runs.values()) if plan else None,
        missing={c.name: read_progress(plan.folder_of(c))[0] for c in plan.unfinished}
        if plan
        else {},
        left_out=list(left_out),
        versions=_distinct(run["versions"] for run in runs.values()),
        processors=_distinct(run["cpu"] for run in runs.values()),
        labels={label: _label(of_label) for label, of_label in labels.items()},
        runs=[_run(run) for run in runs.values()],
    )


def _run(run: Mapping[str, Any]) -> RunFacts:
    own = {name: run["settings"][name] for name in ("seed", "encoder", "encoder_seed")}
    ended = {name: run[name] for name in ("status", "steps", "seconds")}
    label = run_label(run["settings"])
    return RunFacts(label=label, reason=run.get("reason"), **own, **ended)


def _sort_key(settings: Mapping[str, Any], order: list[str]) -> tuple[Any, ...]:
    """By task, algorithm, representation (in the order of tables) and seed."""
    representation = order.index(settings["representation"])
    return settings["task"], learner(settings), representation, settings["seed"]


def run_label(settings: Mapping[str, Any]) -> str:
    """Task, learner, representation: face_direction/sac-modern/dae-8."""
    return f"{settings['task']}/{learner(settings)}/{settings['representation']}"


def run_name(settings: Mapping[str, Any]) -> str:
    """The same with the seed: face_direction/sac-modern/dae-8/seed-0."""
    return f"{run_label(settings)}/seed-{settings['seed']}"


def learner(settings: Mapping[str, Any]) -> str:
    """What tables call the algorithm with its settings: ddpg, sac-modern, my-sac."""
    return settings.get("learner") or base_name(settings["algorithm"], settings["preset"])


def shared_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that all runs of a label share: without the seed and what depends on it."""
    own = ("seed", "encoder_seed", "registration")
    shared = {name: value for name, value in settings.items() if name not in own}
    if settings["encoder_seed"] is not None:
        shared["encoder"] = EACH_ITS_OWN
    if settings["from"] is not None:
        shared["from"] = "another run's policy"
    return shared


def _label(runs: Mapping[Path, Mapping[str, Any]]) -> Label:
    """What the runs of a label share, by folder."""
    settings = from_plain(shared_settings(next(iter(runs.values()))["settings"]), LabelSettings)
    folders = list(runs) if settings.encoder == EACH_ITS_OWN else list(runs)[:1]
    encoder = _common([_encoder(each, runs[each]) for each in folders])
    return Label(settings=settings, encoder=encoder)


def _encoder(folder: Path, run: Mapping[str, Any]) -> EncoderFacts:
    """What is known of a run's encoder; of a user's own, its sizes alone."""
    settings: Mapping[str, Any] = run["settings"]
    if "latent_size" in run and not exists(folder / ENCODER):
        return EncoderFacts(
            name=settings["encoder_code"] or "an object in Python",
            kind=OWN,
            size=from_plain(settings["environment"], Task).size,
            latent_size=run["latent_size"],
            encoder=[],
            decoder=[],
            training={},
            data={},
            metrics={},
        )
    encoder = load(folder / ENCODER)
    return EncoderFacts(
        name=encoder.name,
        kind=encoder.kind,
        size=encoder.size,
        latent_size=encoder.latent_size,
        encoder=[(len(layer.bias), layer.activation) for layer in encoder.encoder],
        decoder=[(len(layer.bias), layer.activation) for layer in encoder.decoder],
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


def _registration(plan: Plan, runs: Iterable[Mapping[str, Any]]) -> RegistrationFacts | None:
    """When a study was registered, and how what ran differs from that; None if it wasn't."""
    if plan.registration is None:
        return None
    named = {run_name(run["settings"]): run for run in runs}
    return RegistrationFacts(
        sha256=plan.registration.sha256,
        date=plan.registration.date,
        deviations=deviations(plan.registration, plan.study, named),
    )


def _distinct(values: Iterable[_Value]) -> list[_Value]:
    distinct: list[_Value] = []
    for value in values:
        if value not in distinct:
            distinct.append(value)
    return distinct
