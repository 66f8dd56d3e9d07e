"""What a study found and how it ran: findings.json, from which every output is made."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from jbrep.dataset.scaling import EXTREMA
from jbrep.encoders import FULL
from jbrep.encoders.base import OWN
from jbrep.envs.infos import shares
from jbrep.envs.names import modules_of
from jbrep.evaluation.diagnosis import SCALARS
from jbrep.evaluation.evaluation import Score
from jbrep.records.document import Document
from jbrep.records.record import Record, from_plain
from jbrep.records.record import to_plain as record_to_plain
from jbrep.reporting.tables import Tables
from jbrep.rl.files import FAILED
from jbrep.stats.analysis import Analysis, GroupAnalysis, to_plain
from jbrep.stats.intervals import LEVEL, Bounds, mean_within, rank_correlation, unless_few
from jbrep.stats.labels import YES
from jbrep.stats.runs import in_order
from jbrep.stats.scale import SOLVED
from jbrep.studies.record import EACH_ITS_OWN, Label, RegistrationFacts
from jbrep.studies.tables import by_run, run_of

RUNNING = "running mean and variance"  # of what agents see, where they normalise it
_NOT_SHOWN = ("task", "representation", "encoder", "encoder_code")  # among the settings
_MOST_NAMED = 4  # representations in a title
Numbers = dict[str, Score]  # by name, each with its 95 % interval; None where it isn't known


class Agents(Record, frozen=True, kw_only=True):
    """The runs of one representation, with one task and algorithm."""

    representation: str
    settings: str  # hash of those that all runs share
    seeds: list[int]
    failed: list[int]  # seeds
    encoders: int
    learnt: str  # whether they end above the best blind baseline: yes, no or unclear
    rises: bool  # whether returns surely still rise at the end of training
    curve: dict[str, Any]  # over the grid of the group: percentiles, mean, IQM with its interval
    by_run: dict[str, list[float | None]]  # in the order of seeds
    numbers: Numbers
    shares: Numbers  # of episodes, such as of successes
    profile: list[Score]  # share of runs above each of the group's profile_returns


class Comparison(Record, frozen=True, kw_only=True):
    """A representation against the baseline."""

    representation: str
    numbers: Numbers
    brown_forsythe_p: float | None
    shared: int  # seeds of both
    by_encoder: bool


class Group(Record, frozen=True, kw_only=True):
    """What was found of one task and algorithm; `jbrep.stats.analysis` says what each number is."""

    task: str
    algorithm: str
    grid: list[float]  # training steps
    cut: str | None
    return_floor: float | None
    return_ceiling: float | None
    failure_return: float | None
    ends: dict[str, float | None]  # returns that score 0 and 1
    blind: Score
    best_policy: str | None  # of the blind baselines
    references: Numbers
    in_training: dict[str, float]  # the same, if all evaluations have the same starts; else empty
    thresholds: dict[str, float | None]
    profile_returns: list[float]
    agents: list[Agents]  # the baseline first
    comparisons: list[Comparison]

    @property
    def name(self) -> str:
        """Task and algorithm, for titles."""
        return f"{self.task}, {self.algorithm}"

    @property
    def solved(self) -> float | None:
        """The return from which on the task counts as solved."""
        return self.thresholds[SOLVED]

    @property
    def compared(self) -> list[Comparison]:
        """What can be compared with the baseline: nothing if that didn't learn."""
        return self.comparisons if self.agents[0].learnt == YES else []


class Verdict(Record, frozen=True, kw_only=True):
    """What is found of a claim on one task and algorithm, as in `jbrep.stats.rules`."""

    task: str
    algorithm: str
    x: str
    claim: str
    y: str
    verdict: str
    estimate: Score
    boundary: float | None
    interval: Score
    width: float | None
    p: float | None
    level: float | None
    runs: int
    units: int
    by_encoder: bool
    by: int | None
    reason: str | None

    @property
    def sentence(self) -> str:
        """The claim."""
        return f"{self.x} {self.claim} than {self.y}"


class Aggregate(Record, frozen=True, kw_only=True):
    """A representation's scores across tasks, with one algorithm."""

    algorithm: str
    representation: str
    tasks: list[str]
    runs: int
    iqm: Score
    optimality_gap: Score
    scores: list[float]
    profile: list[Score]


class Diagnosed(Record, frozen=True, kw_only=True):
    """A diagnostic of a task's representations, beside what one algorithm learned from them."""

    task: str
    algorithm: str
    diagnostic: str
    words: str
    better: int  # 1 if higher is better, -1 if lower is
    representations: list[str]
    values: list[float]
    final_returns: list[float]
    families: list[str]
    correlation: Score  # of ranks


class RunFound(Record, frozen=True, kw_only=True):
    """A run that has finished or failed."""

    label: str
    seed: int
    status: str
    reason: str | None
    steps: int
    minutes: float
    curve: list[tuple[int, float]]  # step and mean return of each evaluation
    returns: list[float]  # of the last one
    shares: dict[str, float]  # of its episodes


class Scaling(Record, frozen=True, kw_only=True):
    """How the full observation is scaled."""

    ways: list[str]
    states: list[int]  # that it was fitted on
    of_codes: list[int]  # that codes were made from


class Findings(Document, frozen=True, kw_only=True):
    """All that a report says."""

    format = "jbrep findings"
    format_version = 1
    indent = 1

    name: str
    title: str
    tasks: list[str]
    algorithms: list[str]
    representations: list[str]
    own_encoders: list[str]  # representations whose runs have different encoders
    baseline: str
    top: str  # the policy that scores 1, if that has a name
    is_study: bool
    registration: RegistrationFacts | None
    comparisons: int  # that share the error: chains of claims, on each task and algorithm
    error: float
    planned_seeds: int
    scaling: Scaling | None
    missing: dict[str, int]  # unfinished runs: training steps done
    left_out: list[str]  # what there are no statistics of, and why
    not_played: list[str]  # tasks without reference policies
    verdicts: list[Verdict]
    groups: list[Group]
    aggregates: list[Aggregate]
    diagnostics: list[Diagnosed]
    runs: list[RunFound]
    versions: list[dict[str, str]]
    processors: list[str]
    encoders: list[dict[str, Any]]
    settings: dict[str, dict[str, Any]]  # that agents share, by task and algorithm
    study: str | None  # its file
    imports: list[str]  # modules of its own robots and encoders

    @classmethod
    def of(cls, tables: Tables) -> "Findings":
        """What the tables of a study say."""
        record, analysis, runs = tables.raw.record, tables.analysis, _runs(tables)
        labels, planned = record.labels, record.planned
        settings = [label.settings for label in labels.values()]
        own = (each.representation for each in settings if each.encoder == EACH_ITS_OWN)
        seen = in_order((each.representation for each in settings), FULL)
        top = planned.rules.top
        return cls(
            name=tables.name,
            title=(record.study.title if record.study else "") or _title([*record.tasks], seen),
            tasks=[*record.tasks],
            algorithms=[*dict.fromkeys(each.learner for each in settings)],
            representations=seen,
            own_encoders=in_order(own, FULL),
            baseline=record.baseline,
            top=top if isinstance(top, str) else "",
            is_study=record.study is not None,
            registration=record.registration,
            comparisons=len(planned.rules.chains) * len(planned.groups),
            error=planned.rules.error,
            planned_seeds=len(planned.seeds),
            scaling=_scaling([*labels.values()]),
            missing=record.missing,
            left_out=tables.left_out,
            not_played=sorted({*record.tasks} - {*tables.raw.references}),
            verdicts=to_plain(analysis.verdicts) if analysis else [],
            groups=groups_of(analysis, runs, _in_training(tables)) if analysis else [],
            aggregates=to_plain(analysis.aggregates) if analysis else [],
            diagnostics=[*_diagnosed(tables, analysis)] if analysis else [],
            runs=runs,
            versions=record.versions,
            processors=record.processors,
            encoders=[{"runs": label, **_encoder(shared)} for label, shared in labels.items()],
            settings=_settings(tables),
            study=record.study.toml().rstrip() if record.study else None,
            imports=_imports(tables),
        )

    @property
    def failed(self) -> list[RunFound]:
        """Runs that failed."""
        return [run for run in self.runs if run.status == FAILED]

    def verdicts_of(self, task: str, algorithm: str) -> list[Verdict]:
        """On the claims of one task and algorithm."""
        return [v for v in self.verdicts if (v.task, v.algorithm) == (task, algorithm)]


def groups_of(
    analysis: Analysis,
    runs: Sequence[RunFound] = (),
    in_training: Mapping[str, dict[str, float]] = {},
) -> list[Group]:
    """The statistics of each task and algorithm, with shares of their runs' episodes.

    The returns of policies in training are by task.
    """
    shared: dict[str, dict[str, list[float]]] = {}
    for run in runs:
        for name, share in run.shares.items():
            shared.setdefault(run.label, {}).setdefault(name, []).append(share)
    return [_group(each, shared, in_training.get(each.task, {})) for each in analysis.groups]


def _group(
    group: GroupAnalysis, shared: Mapping[str, Mapping[str, list[float]]], played: dict[str, float]
) -> Group:
    plain, agents = to_plain(group), []
    for label, of_label in zip(group.labels, plain.pop("labels"), strict=True):
        own = shared.get(f"{group.task}/{group.algorithm}/{label.representation}", {})
        means = {
            name: unless_few(mean_within(np.array(values), Bounds(0, 1), LEVEL), len(values))
            for name, values in own.items()
        }
        agents.append({**of_label, "rises": label.rises, "shares": to_plain(means)})
    return Group(
        **plain,
        agents=from_plain(agents, list[Agents]),
        best_policy=group.best_policy,
        in_training=played,
    )


def _runs(tables: Tables) -> list[RunFound]:
    """Every run, with its curve; as shares, numbers that are 0 or 1 in all episodes of a task."""
    returns = by_run(tables.raw.returns)
    infos = dict[tuple[str, int], dict[str, list[float]]]()
    of_task = dict[str, dict[str, list[float]]]()
    for row in tables.raw.infos:  # of last evaluations
        if row.step == max(returns.get(run_of(row), ()), default=None):
            infos.setdefault(run_of(row), {}).setdefault(row.name, []).append(row.value)
            of_task.setdefault(row.task, {}).setdefault(row.name, []).append(row.value)
    known = {task: shares(values) for task, values in of_task.items()}
    found = []
    for run in tables.raw.record.runs:
        by_step = returns.get((run.label, run.seed), {})
        fewest = min(map(len, by_step.values()), default=0)  # the last evaluation may have more
        numbers = {} if run.status == FAILED else infos.get((run.label, run.seed), {})
        share_names = known.get(run.label.rsplit("/", 2)[0], {})
        found.append(
            RunFound(
                **{name: getattr(run, name) for name in ("label", "seed", "status", "reason")},
                steps=run.steps,
                minutes=round(run.seconds / 60, 1),
                curve=[(step, float(np.mean(each[:fewest]))) for step, each in by_step.items()],
                returns=by_step[max(by_step)] if by_step else [],
                shares={n: float(np.mean(each)) for n, each in numbers.items() if n in share_names},
            )
        )
    return found


def _in_training(tables: Tables) -> dict[str, dict[str, float]]:
    """Means of policies that don't learn, for tasks whose curves are of the same starts.

    Where only the last evaluation has all starts, curves of the others can't stand beside them.
    """
    fewest: dict[str, int] = {}
    for (label, _), by_step in by_run(tables.raw.returns).items():
        task, count = label.rsplit("/", 2)[0], min(map(len, by_step.values()))
        fewest[task] = min(fewest.get(task, count), count)
    return {
        task: {policy: float(np.mean(each)) for policy, each in played.items()}
        for task, played in tables.raw.references.items()
        if all(len(each) == fewest.get(task) for each in played.values())
    }


def _diagnosed(tables: Tables, analysis: Analysis) -> Iterator[Diagnosed]:
    """Each registered diagnostic that is known of some representation, with final returns."""
    family_of = {}
    for label in tables.raw.record.labels.values():
        name, kind = label.settings.representation, label.encoder.kind
        family_of[label.settings.task, name] = name if kind == OWN else kind
    for group in analysis.groups:
        returns = {
            each.representation: float(each.numbers["final_return_mean"].value)
            for each in group.labels
        }
        for name, scalar in SCALARS.items():
            values = {each: tables.diagnostics.get((group.task, each), {}) for each in returns}
            known = {n: each[name] for n, each in values.items() if each.get(name) is not None}
            if not known:
                continue
            families = [family_of[group.task, each] for each in known]
            x, y = np.array([*known.values()]), np.array([returns[each] for each in known])
            correlation = rank_correlation(scalar.better * x, y, families)
            yield Diagnosed(
                task=group.task,
                algorithm=group.algorithm,
                diagnostic=name,
                words=scalar.words,
                better=scalar.better,
                representations=[*known],
                values=x.tolist(),
                final_returns=y.tolist(),
                families=families,
                correlation=Score(*correlation.tolist()),
            )


def _scaling(labels: Sequence[Label]) -> Scaling | None:
    full = [each for each in labels if each.settings.representation == FULL]
    if not full:
        return None
    ways = {
        RUNNING
        if each.settings.hyperparameters.normalize
        else each.encoder.training.get("scaling", EXTREMA)
        for each in full
    }
    states, of_codes = (
        sorted({*filter(None, (each.encoder.data.get("train_rows") for each in some))})
        for some in (full, [each for each in labels if each.settings.representation != FULL])
    )
    return Scaling(ways=sorted(ways), states=states, of_codes=of_codes)


def _encoder(shared: Label) -> dict[str, Any]:
    encoder = shared.encoder
    layers = [f"{units} {activation}" for units, activation in (*encoder.encoder, *encoder.decoder)]
    own = [str(encoder.latent_size or "?")] if encoder.kind == OWN else []
    return {
        "encoder": encoder.name,
        "layers": " - ".join((str(encoder.size), *layers, *own)),
        "held-out error": encoder.metrics.get("held_out_mse"),
        "training states": encoder.data.get("train_rows"),
        "SHA-256": shared.settings.encoder,
    }


def _settings(tables: Tables) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for shared in tables.raw.record.labels.values():
        settings, task = record_to_plain(shared.settings), shared.settings.environment
        settings["environment"]["domain"] = str(task.domain or "") or None
        settings["environment"]["features"] = [feature.name for feature in task.features]
        every = dict(_flat(settings))
        for name, values in tables.raw.record.draws_of(shared.settings.learner).items():
            every[name] = f"one of {', '.join(map(str, values))}, by seed"
        shown = {name: value for name, value in every.items() if name not in _NOT_SHOWN}
        found.setdefault(f"{shared.settings.task}/{shared.settings.learner}", shown)
    return found


def _title(tasks: Sequence[str], seen: Sequence[str]) -> str:
    """What was studied, where its file has no title."""
    shown = ", ".join(seen) if len(seen) <= _MOST_NAMED else f"{len(seen)} representations"
    return f"{', '.join(tasks)}: {shown}"


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        yield from _flat(value) if isinstance(value, Mapping) else [(name, value)]


def _imports(tables: Tables) -> list[str]:
    record = tables.raw.record
    own = record.study.representations if record.study else ()
    codes = [each["code"] for each in own if isinstance(each, Mapping) and "code" in each]
    modules = (str(code).partition(":")[0] for code in codes)
    return [*dict.fromkeys(chain(*map(modules_of, record.tasks.values()), modules))]
