"""Everything in a report but its statistics: what ran, how, and how to run it again."""

import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from jbrep.encoders import FULL
from jbrep.encoders.base import OWN
from jbrep.encoders.header import HELD_OUT_MSE
from jbrep.report.figures.diagrams import EncoderRecord, LabelRecord
from jbrep.report.tables import Tables
from jbrep.rl.record import FAILED
from jbrep.rl.settings import TrainingSettings
from jbrep.stats.runs import in_order
from jbrep.stats.summary import shown_number
from jbrep.study.record import EACH_ITS_OWN
from jbrep.text import SIGNIFICANT, number, slug

Row = tuple[str, ...]
Rows = list[Row]
_BARE = re.compile(r"[\w-]+", re.ASCII)  # a key that TOML needs no quotes for
_OPTIONS = ("task", "algorithm", "preset", *TrainingSettings.__struct_fields__)  # of jbrep rl


def outline(tables: Tables) -> str:
    """What was run, in a sentence or two."""
    settings = [shared["settings"] for shared in tables.record["labels"].values()]
    tasks = dict.fromkeys(each["task"] for each in settings)
    algorithms = dict.fromkeys(each["learner"] for each in settings)
    representations = in_order((each["representation"] for each in settings), FULL)
    runs = tables.record["runs"]
    total = len(runs) + len(tables.record["missing"])
    failed = sum(run["status"] == FAILED for run in runs)
    steps = max(run["steps"] for run in runs)
    own = in_order(
        (each["representation"] for each in settings if each["encoder"] == EACH_ITS_OWN), FULL
    )
    return (
        f"{', '.join(algorithms)} on {', '.join(tasks)} with the representations "
        f"{', '.join(representations)}: {len(runs) - failed} of {total} runs finished, {failed} "
        f"failed; up to {steps:,} steps each."
        + (f" With {', '.join(own)}, {EACH_ITS_OWN}." if own else "")
    )


def registered(tables: Tables) -> str:
    """Whether what ran is what was registered, in a sentence; empty for runs without a study."""
    if not tables.record["study"]:
        return ""
    registration = tables.record.get("registration")
    if not registration:
        return "This study was not registered before its first run."
    so_far = "what ran so far" if tables.record["missing"] else "what ran"
    since = f"Registered on {registration['date'][:10]}, SHA-256 {registration['sha256'][:12]}: "
    if not registration["deviations"]:
        return f"{since}{so_far} is what was registered."
    return f"{since}{'; '.join(registration['deviations'])}."


def notices(tables: Tables) -> list[str]:
    """What the report lacks."""
    lines = []
    if missing := list(tables.record["missing"]):
        names = ", ".join(missing[:3]) + (" and others" if len(missing) > 3 else "")
        lines.append(
            f"This study is unfinished: {_runs(missing)} missing ({names}). The same jbrep study "
            "command resumes it."
        )
    if failed := failed_rows(tables):
        lines.append(f"{_runs(failed)} {_failing(tables)}; the reasons are given under Runs.")
    return [*lines, *(f"No statistics: {line}." for line in tables.record["left_out"])]


def _failing(tables: Tables) -> str:
    """What failed runs count as."""
    groups = tables.analysis.groups if tables.analysis else ()
    failed = [group for group in groups if any(label.failed for label in group.labels)]
    if not failed:
        return "marked as failed"
    returns = " or ".join(dict.fromkeys(shown_number(group.failure_return) for group in failed))
    return (
        f"counted as return {returns}, the worst of the task and algorithm, from the step of "
        "failure on"
    )


def _runs(which: Sequence[object]) -> str:
    return "1 run is" if len(which) == 1 else f"{len(which)} runs are"


def run_rows(tables: Tables) -> Rows:
    """A row for each finished or failed run."""
    returns: dict[tuple[str, int], dict[int, list[float]]] = {}
    for row in tables.returns:
        label = f"{row.task}/{row.algorithm}/{row.representation}"
        of_run = returns.setdefault((label, row.seed), {})
        of_run.setdefault(row.step, []).append(row.episode_return)
    return [
        (
            run["label"],
            str(run["seed"]),
            run["status"],
            f"{run['steps']:,}",
            _last(returns.get((run["label"], run["seed"]), {})),
            f"{run['seconds'] / 60:.1f}",
        )
        for run in tables.record["runs"]
    ]


def _last(returns: Mapping[int, list[float]]) -> str:
    """The mean return of the last evaluation, from the returns at each step."""
    if not returns:
        return "-"
    final = returns[max(returns)]
    return number(sum(final) / len(final), SIGNIFICANT)


def failed_rows(tables: Tables) -> Rows:
    """A row for each failed run."""
    return [
        (run["label"], str(run["seed"]), f"{run['steps']:,}", run["reason"] or "-")
        for run in tables.record["runs"]
        if run["status"] == FAILED
    ]


def missing_rows(tables: Tables) -> Rows:
    """A row for each unfinished run."""
    return [(name, f"{steps:,}") for name, steps in tables.record["missing"].items()]


def version_rows(tables: Tables) -> Rows:
    """A row for each package."""
    numbers: dict[str, dict[str, None]] = {}
    for versions in tables.record["versions"]:
        for package, version in versions.items():
            numbers.setdefault(package, {})[version] = None
    return [(package, ", ".join(each)) for package, each in numbers.items()]


def encoder_rows(tables: Tables) -> Rows:
    """A row for each label."""
    return [_encoder_row(label, shared) for label, shared in tables.record["labels"].items()]


def _encoder_row(label: str, shared: LabelRecord) -> Row:
    encoder, fingerprint = shared["encoder"], shared["settings"]["encoder"]
    error, rows = encoder["metrics"].get(HELD_OUT_MSE), encoder["data"].get("train_rows")
    return (
        label,
        encoder["name"],
        _layers(encoder),
        "-" if error is None else f"{error:.2g}",
        "-" if rows is None else f"{rows:,}",
        fingerprint if fingerprint == EACH_ITS_OWN else fingerprint[:12],
    )


def _layers(encoder: EncoderRecord) -> str:
    """Such as 16 - 8 tanh - 16 tanh; of a user's own encoder 16 - 8."""
    if encoder["kind"] == OWN:
        return f"{encoder['size']} - {encoder.get('latent_size', '?')}"
    layers = [*encoder["encoder"], *encoder["decoder"]]
    return " - ".join([str(encoder["size"]), *(f"{units} {kind}" for units, kind in layers)])


def setting_rows(tables: Tables) -> tuple[Row, Rows]:
    """The settings that agents share, a column for each task and algorithm."""
    columns: dict[str, Mapping[str, Any]] = {}
    for shared in tables.record["labels"].values():
        settings = shared["settings"]
        columns.setdefault(f"{settings['task']}/{settings['learner']}", dict(_flat(settings)))
    names = dict.fromkeys(name for settings in columns.values() for name in settings)
    skipped = ("task", "representation", "encoder", "encoder_code")
    rows = [
        (name, *(_shown(settings.get(name)) for settings in columns.values()))
        for name in names
        if name not in skipped
    ]
    return ("setting", *columns), rows


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if name == "overrides":
            yield name, ", ".join(f"{each} {_shown(own)}" for each, own in value.items()) or None
        elif isinstance(value, Mapping):
            yield from _flat(value)
        else:
            yield name, value


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return "-" if value is None else str(value)


def reproduce(tables: Tables) -> list[tuple[str, str]]:
    """Commands and files, each with a line on what it does."""
    versions = " ".join(
        f"{package}=={number.partition('+')[0]}"
        for package, number in tables.record["versions"][0].items()
        if package != "jbrep"
    )
    first = (
        f"In a checkout of jbrep {tables.record['versions'][0]['jbrep']}, with these versions "
        "(equal results also need the same kind of processor):",
        f"pip install '.[learn]' {versions}",
    )
    folder = shlex.quote(tables.name)
    report = ("The tables, the figures and this page, from the runs:", f"jbrep report {folder}")
    study = tables.record["study"]
    if study:
        toml = ("This file, as study.toml:", _toml(study))
        command = f"jbrep study study.toml --out {folder}{_imports(study)}"
        return [first, toml, ("All runs:", command), report]
    commands = "\n".join(
        _command(shared, f"{tables.name}/{_folder(shared['settings'])}/seed-0")
        for shared in tables.record["labels"].values()
    )
    return [first, ("Each run, here with one seed:", commands), report]


def _imports(study: Mapping[str, Any]) -> str:
    """The options that import the modules of a study's own encoders."""
    own = (each for each in study["representations"] if isinstance(each, Mapping))
    modules = dict.fromkeys(str(each["code"]).partition(":")[0] for each in own if "code" in each)
    return "".join(f" --import {shlex.quote(module)}" for module in modules)


def _toml(study: Mapping[str, Any]) -> str:
    """A study as the file that describes it."""
    lines, below = [], []
    own = study.get("learners", {})
    given_algorithms = {name: own.get(name, {}) for name in study["algorithms"]}
    below += [line for each in given_algorithms.items() if own for line in _learner_table(*each)]
    for name, value in study.items():
        if name == "learners" or (name == "algorithms" and own):
            continue
        if isinstance(value, Mapping):
            unset = ("", 0) if name == "data" else ()  # either steps or a folder is given there
            given = {key: each for key, each in value.items() if each not in unset}
            cells = [f"{key} = {_inline(each)}" for key, each in given.items()]
            below += ["", f"[{name}]", *cells] if cells else []
        elif value not in (None, []):
            lines.append(f"{name} = {_inline(value)}")
    return "\n".join(lines + below)


def _learner_table(name: str, table: Mapping[str, Any]) -> list[str]:
    """The lines of a learner's table."""
    return ["", f"[algorithms.{_key(name)}]", *(f"{n} = {_inline(v)}" for n, v in table.items())]


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name)


def _inline(value: Any) -> str:
    """A value as TOML on one line."""
    if isinstance(value, Mapping):
        cells = map(" = ".join, zip(map(_key, value), map(_inline, value.values()), strict=True))
        return f"{{ {', '.join(cells)} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    return json.dumps(value)


def _folder(settings: Mapping[str, Any]) -> str:
    """Of the runs with a label, below that of all; a task's id may contain a slash."""
    return "/".join(map(slug, (settings["task"], settings["learner"], settings["representation"])))


def _command(shared: LabelRecord, out: str) -> str:
    settings: Mapping[str, Any] = shared["settings"]
    parts = ["jbrep", "rl"]
    for name in _OPTIONS:
        if name in settings:  # runs of the first release lack some
            parts += [f"--{name.replace('_', '-')}", str(settings[name])]
    for name, value in settings.get("overrides", {}).items():
        parts += ["--set", f"{name}={json.dumps(value)}"]
    environment: Mapping[str, Any] = settings.get("environment", {})
    for name, value in environment.get("arguments", {}).items():
        parts += ["--env", f"{name}={json.dumps(value)}"]
    if steps := environment.get("max_episode_steps"):
        parts += ["--episode-steps", str(steps)]
    encoder = settings.get("encoder_code") or shared["encoder"]["name"]
    parts += ["--encoder", encoder, "--seed", "0", "--out", out]
    return shlex.join(parts)
