"""Everything in a report but its statistics: what ran, how, and how to run it again."""

import json
import math
import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from typing import Any

from jbrep.encoders import FULL
from jbrep.encoders.base import OWN
from jbrep.encoders.shipped import UNLEARNED, find, names
from jbrep.envs.names import modules_of
from jbrep.errors import InputError
from jbrep.records.keys import option_name
from jbrep.records.record import to_plain
from jbrep.report.tables import Tables
from jbrep.report.words import shown_number
from jbrep.rl.files import ENCODER, FAILED
from jbrep.rl.settings import TrainingSettings
from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.runs import in_order
from jbrep.study.config import Study
from jbrep.study.record import EACH_ITS_OWN, EncoderFacts, Label, RunsRecord
from jbrep.study.tables import by_run
from jbrep.text import SIGNIFICANT, Table, number, slug

_FEW = 6  # representations that are named
RUNNING = "running mean and variance"  # of what agents see, where they normalise it
_NOT_SHOWN = ("task", "representation", "encoder", "encoder_code")  # among the settings
_KEPT = f"RUN/{ENCODER}"
_OPTIONS = ("algorithm", "preset", *TrainingSettings.__struct_fields__)  # of jbrep rl


def outline(tables: Tables) -> str:
    """What was run, in a sentence or two."""
    settings = [shared.settings for shared in tables.record.labels.values()]
    tasks = dict.fromkeys(each.task for each in settings)
    algorithms = dict.fromkeys(each.learner for each in settings)
    representations = in_order((each.representation for each in settings), FULL)
    runs = tables.record.runs
    total = len(runs) + len(tables.record.missing)
    failed = len(failed_runs(tables).rows)
    own = in_order((e.representation for e in settings if e.encoder == EACH_ITS_OWN), FULL)
    return (
        f"{', '.join(algorithms)} on {', '.join(tasks)}, seeing {_some(representations)}: "
        f"{len(runs) - failed} of {total} runs finished, {failed} failed; up to "
        f"{max(run.steps for run in runs):,} steps each."
        + (f" With {_some(own)}, {EACH_ITS_OWN}." if own else "")
    )


def _some(names: Sequence[str]) -> str:
    """Names, or how many there are."""
    if len(names) <= _FEW:
        return ", ".join(names)
    return f"{len(names)} representations"


def full_scaling(tables: Tables) -> str:
    """How the full state is scaled, in a sentence; empty where no agent sees it."""
    labels = tables.record.labels.values()
    full = [each for each in labels if each.settings.representation == FULL]
    if not full:
        return ""
    ways = {
        RUNNING if each.settings.hyperparameters.normalize else each.encoder.shown.scaling
        for each in full
    }
    rows, others = (
        {e.encoder.shown.train_rows for e in labels if (e in full) == is_full} - {None}
        for is_full in (True, False)
    )
    if ways == {"none"}:
        return "The full state isn't scaled."
    told = f"The full state is scaled by {' or '.join(sorted(ways))}"
    if rows:
        told += f" of {_states(rows)} states"
    if rows and others - rows:
        made = f"codes are made of {_states(others)}"
        told += f", {made}: so they differ by more than what they leave out"
    return f"{told}."


def _states(counts: set[int | None]) -> str:
    return " or ".join(f"{count:,}" for count in sorted(filter(None, counts)))


def registered(tables: Tables) -> str:
    """Whether what ran is what was registered, in a sentence; empty for runs without a study."""
    record = tables.record
    if not record.study:
        return ""
    if not record.registration:
        return "This study was not registered before its first run."
    so_far = "what ran so far" if record.missing else "what ran"
    date, sha256 = record.registration.date[:10], record.registration.sha256[:12]
    differing = "; ".join(record.registration.deviations)
    return (
        f"Registered on {date}, SHA-256 {sha256}: "
        f"{differing or f'{so_far} is what was registered'}."
    )


def notices(tables: Tables) -> list[str]:
    """What the report lacks."""
    lines = []
    if missing := list(tables.record.missing):
        names = missing[0] + (" and others" if len(missing) > 1 else "")
        lines.append(
            f"This study is unfinished: {_runs(missing)} missing ({names}). The same jbrep study "
            "command resumes it."
        )
    if failed := failed_runs(tables).rows:
        lines.append(f"{_runs(failed)} {_failing(tables)}; the reasons are given under Runs.")
    return [*lines, *(f"No statistics: {line}." for line in tables.left_out)]


def _failing(tables: Tables) -> str:
    """What failed runs count as."""
    groups = tables.analysis.groups if tables.analysis else ()
    failed = [group for group in groups if any(label.failed for label in group.labels)]
    if not failed:
        return "marked as failed"
    worst = ", or ".join(dict.fromkeys(map(_worst, failed)))
    return f"counted as return {worst}, from the step of failure on"


def _worst(group: GroupAnalysis) -> str:
    """The return of a failed run, and which one that is."""
    is_floor = not math.isnan(group.return_floor)
    which = "the least possible" if is_floor else "the worst of the task and algorithm"
    return f"{shown_number(group.failure_return)}, {which}"


def _runs(which: Sequence[object]) -> str:
    return "1 run is" if len(which) == 1 else f"{len(which)} runs are"


def ended_runs(tables: Tables) -> Table:
    """A row for each finished or failed run, with the mean return of its last evaluation."""
    returns, rows = by_run(tables.returns), []
    for run in tables.record.runs:
        of_run = returns.get((run.label, run.seed), {})
        final = of_run[max(of_run)] if of_run else []
        last = number(sum(final) / len(final), SIGNIFICANT) if final else "-"
        minutes = f"{run.seconds / 60:.1f}"
        rows.append((run.label, str(run.seed), run.status, f"{run.steps:,}", last, minutes))
    return Table(
        "Finished and failed", ("run", "seed", "status", "steps", "last return", "minutes"), rows
    )


def failed_runs(tables: Tables) -> Table:
    """A row for each failed run."""
    return Table(
        "Failed",
        ("run", "seed", "at step", "reason"),
        [
            (run.label, str(run.seed), f"{run.steps:,}", run.reason or "-")
            for run in tables.record.runs
            if run.status == FAILED
        ],
    )


def run_tables(tables: Tables) -> list[Table]:
    """All runs: those that failed, those that go on, those that have ended."""
    unfinished = [(name, f"{steps:,}") for name, steps in tables.record.missing.items()]
    every = failed_runs(tables), Table("Unfinished", ("run", "steps done"), unfinished)
    return [*(table for table in every if table.rows), ended_runs(tables)]


def package_table(tables: Tables) -> Table:
    """A row for each package."""
    numbers: dict[str, dict[str, None]] = defaultdict(dict)
    for versions in tables.record.versions:
        for package, version in versions.items():
            numbers[package][version] = None
    rows = [(package, ", ".join(each)) for package, each in numbers.items()]
    return Table("Packages and processors", ("package", "version"), rows)


def encoder_table(tables: Tables) -> Table:
    """A row for each label."""
    rows = []
    for label, shared in tables.record.labels.items():
        encoder, fingerprint = shared.encoder, shared.settings.encoder
        error, states = encoder.shown.held_out_mse, encoder.shown.train_rows
        rows.append(
            (
                label,
                encoder.name,
                _layers(encoder),
                "-" if error is None else f"{error:.2g}",
                "-" if states is None else f"{states:,}",
                fingerprint if fingerprint == EACH_ITS_OWN else fingerprint[:12],
            )
        )
    header = ("runs", "encoder", "layers", "held-out error", "training states", "SHA-256")
    return Table("Encoders", header, rows)


def _layers(encoder: EncoderFacts) -> str:
    """Such as 16 - 8 tanh - 16 tanh; of a user's own encoder 16 - 8."""
    if encoder.kind == OWN:
        return f"{encoder.size} - {encoder.latent_size or '?'}"
    layers = [*encoder.encoder, *encoder.decoder]
    return " - ".join([str(encoder.size), *(f"{units} {kind}" for units, kind in layers)])


def setting_table(tables: Tables) -> Table:
    """The settings that agents share, a column for each task and algorithm."""
    columns: dict[str, Mapping[str, Any]] = {}
    for shared in tables.record.labels.values():
        settings = to_plain(shared.settings)
        drawn = {
            name: f"one of {_shown([*map(_shown, values)])}, by seed"
            for name, values in tables.record.draws_of(settings["learner"]).items()
        }
        own = {name: value for name, value in settings["overrides"].items() if name not in drawn}
        domain = str(shared.settings.environment.domain or "") or None
        settings["environment"]["domain"] = domain  # what it draws is called as settings are
        flat = dict(_flat({**settings, "overrides": own})) | drawn
        columns.setdefault(f"{settings['task']}/{settings['learner']}", flat)
    names = dict.fromkeys(name for settings in columns.values() for name in settings)
    rows = [
        (name, *(_shown(settings.get(name)) for settings in columns.values()))
        for name in names
        if name not in _NOT_SHOWN
    ]
    return Table("Agents", ("setting", *columns), rows)


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if name == "overrides":
            yield name, ", ".join(f"{each} {_shown(own)}" for each, own in value.items()) or None
        elif isinstance(value, Mapping):
            yield from _flat(value)
        elif name == "features":
            yield name, [feature[0] for feature in value]
        else:
            yield name, value


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return "-" if value is None else str(value)


def reproduce(tables: Tables) -> list[tuple[str, str]]:
    """Commands and files, each with a line on what it does."""
    record = tables.record
    versions = shlex.join(
        f"{package}=={number.partition('+')[0]}"
        for package, number in record.versions[0].items()
        if package != "jbrep"
    )
    first = (
        f"In a checkout of jbrep {record.versions[0]['jbrep']}, with these versions (equal results "
        "also need the same kind of processor):",
        f"pip install '.[learn]' {versions}",
    )
    folder = shlex.quote(tables.name)
    report = ("The tables, the figures and this page, from the runs:", f"jbrep report {folder}")
    if record.study:
        toml = ("This file, as study.toml:", record.study.toml().rstrip())
        command = f"jbrep study study.toml --out {folder}{_imports(record, record.study)}"
        return [first, toml, ("All runs:", command), report]
    commands = "\n".join(
        _command(shared, tables.name, _encoder_of(record, label))
        for label, shared in record.labels.items()
    )
    first_seed = "Each run, here with one seed"
    first_seed += "; an encoder is kept in its run's folder" if _KEPT in commands else ""
    return [first, (f"{first_seed}:", commands), report]


def _encoder_of(record: RunsRecord, label: str) -> str:
    """How a command names the encoder of a label: one that ships by its name."""
    shared = record.labels[label]
    task, name = shared.settings.environment, shared.encoder.name
    used = {run.encoder for run in record.runs if run.label == label}
    with suppress(InputError):  # where what ships is of other features
        if name in (*names(task), *UNLEARNED) and used == {find(name, task).fingerprint}:
            return name
    return shared.settings.encoder_code or _KEPT


def _imports(record: RunsRecord, study: Study) -> str:
    """The options that import the modules of a study's own robots and encoders."""
    tasks = (shared.settings.environment for shared in record.labels.values())
    own = (each for each in study.representations if isinstance(each, Mapping))
    codes = [str(each["code"]).partition(":")[0] for each in own if "code" in each]
    modules = dict.fromkeys((*chain.from_iterable(map(modules_of, tasks)), *codes))
    return "".join(f" --import {shlex.quote(module)}" for module in modules)


def _command(shared: Label, folder: str, encoder: str) -> str:
    """The command that trains one run of a label on an encoder."""
    settings, task = shared.settings, shared.settings.environment
    view = task.view
    parts = ["jbrep", "rl", "--task", task.name.removesuffix(view.suffix) if view else task.name]
    for name in _OPTIONS:
        parts += [option_name(name), str(getattr(settings, name))]
    for name in view.hidden if view else ():
        parts += ["--hide", name]
    if view and view.history > 1:
        parts += ["--history", str(view.history)]
    if task.missing:
        parts += ["--missing", task.missing]
    for name in modules_of(task):
        parts += ["--import", name]
    for name, value in settings.overrides.items():
        parts += ["--set", f"{name}={json.dumps(value)}"]
    for each in task.given_arguments:
        parts += ["--env", each]
    for each in str(task.domain or "").split(","):
        parts += ["--domain", each] if each else []
    parts += ["--episode-steps", str(task.max_episode_steps)]
    label = settings.task, settings.learner, settings.representation
    out = "/".join((folder, *map(slug, label), "seed-0"))  # a task's id may contain a slash
    if settings.begin_from is not None:
        parts += ["--from", "ANOTHER-RUN"]
    parts += ["--encoder", encoder, "--seed", "0", "--out", out]
    return shlex.join(parts)
