"""What a report says of a study besides its statistics: what ran, how, and how to run it again."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from jbrep.encoders import FULL
from jbrep.report.tables import Tables
from jbrep.rl.files import FAILED
from jbrep.stats.runs import in_order
from jbrep.study.record import learner

Row = tuple[str, ...]
Rows = list[Row]


def outline(tables: Tables) -> str:
    """What was run, in a sentence or two."""
    settings = [shared["settings"] for shared in tables.record["labels"].values()]
    tasks = dict.fromkeys(each["task"] for each in settings)
    algorithms = dict.fromkeys(map(learner, settings))
    seen = in_order((each["representation"] for each in settings), FULL)
    runs = tables.record["runs"]
    counts = Counter(run["status"] for run in runs)
    steps = max(run["steps"] for run in runs)
    total = len(runs) + len(tables.record["missing"])
    return (
        f"{', '.join(algorithms)} on {', '.join(tasks)}, seen as {', '.join(seen)}: "
        f"{len(runs)} of {total} runs are over, {counts[FAILED]} of them failed; up to {steps:,} "
        "steps each."
    )


def notices(tables: Tables) -> list[str]:
    """What keeps the report from being whole."""
    found = []
    if missing := list(tables.record["missing"]):
        names = ", ".join(missing[:3]) + (" and others" if len(missing) > 3 else "")
        found.append(
            f"This study is not finished: {len(missing)} {_runs(missing)} missing ({names}). The "
            "same jbrep study goes on."
        )
    if failed := failed_rows(tables):
        found.append(
            f"{len(failed)} {_runs(failed)} counted as return 0 from the step on at which they "
            "failed; why stands below."
        )
    return [*found, *(f"No statistics: {line}." for line in tables.record["left_out"])]


def _runs(which: Sequence[object]) -> str:
    return "run is" if len(which) == 1 else "runs are"


def run_rows(tables: Tables) -> Rows:
    """A line for each run that is over."""
    last: dict[tuple[str, int], dict[int, list[float]]] = {}
    for row in tables.returns:
        label = f"{row.task}/{row.algorithm}/{row.representation}"
        steps = last.setdefault((label, row.seed), {})
        steps.setdefault(row.step, []).append(row.episode_return)
    return [
        (
            run["label"],
            str(run["seed"]),
            run["status"],
            f"{run['steps']:,}",
            _end(last.get((run["label"], run["seed"]), {})),
            f"{run['seconds'] / 60:.1f}",
        )
        for run in tables.record["runs"]
    ]


def _end(returns: Mapping[int, list[float]]) -> str:
    """The mean of the last evaluation."""
    if not returns:
        return "-"
    final = returns[max(returns)]
    return f"{sum(final) / len(final):.0f}"


def failed_rows(tables: Tables) -> Rows:
    """A line for each run that failed."""
    return [
        (run["label"], str(run["seed"]), f"{run['steps']:,}", run["reason"] or "-")
        for run in tables.record["runs"]
        if run["status"] == FAILED
    ]


def missing_rows(tables: Tables) -> Rows:
    """A line for each run that isn't over."""
    return [(name, f"{steps:,}") for name, steps in tables.record["missing"].items()]


def version_rows(tables: Tables) -> Rows:
    """A line for each package."""
    found: dict[str, list[str]] = {}
    for versions in tables.record["versions"]:
        for package, number in versions.items():
            found.setdefault(package, [])
            if number not in found[package]:
                found[package].append(number)
    return [(package, ", ".join(numbers)) for package, numbers in found.items()]


def encoder_rows(tables: Tables) -> Rows:
    """A line for each label."""
    found: Rows = []
    for label, shared in tables.record["labels"].items():
        encoder = shared["encoder"]
        error, data = encoder["metrics"].get("held_out_mse"), encoder["data"]
        found.append(
            (
                label,
                encoder["name"],
                layers(encoder),
                "-" if error is None else f"{error:.2g}",
                f"{data['train_rows']:,} states" if "train_rows" in data else "-",
                shared["settings"]["encoder"][:12],
            )
        )
    return found


def layers(encoder: Mapping[str, Any]) -> str:
    """As 16 - 8 tanh - 16 tanh."""
    sizes = [
        f"{units} {activation}" for units, activation in encoder["encoder"] + encoder["decoder"]
    ]
    return " - ".join([str(encoder["size"]), *sizes])


def setting_rows(tables: Tables) -> tuple[Row, Rows]:
    """What agents share besides their seeds, a column for each task and algorithm."""
    columns: dict[str, Mapping[str, Any]] = {}
    for label, shared in tables.record["labels"].items():
        columns.setdefault(label.rpartition("/")[0], dict(_flat(shared["settings"])))
    names = dict.fromkeys(name for settings in columns.values() for name in settings)
    skipped = ("task", "representation", "encoder")
    rows = [
        (name, *(_said(settings.get(name)) for settings in columns.values()))
        for name in names
        if name not in skipped
    ]
    return ("setting", *columns), rows


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value)
        else:
            yield name, value


def _said(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return "-" if value is None else str(value)


def reproduce(tables: Tables) -> list[tuple[str, str]]:
    """What to type, each with a line on what it does."""
    versions = " ".join(
        f"{package}=={number.partition('+')[0]}"
        for package, number in tables.record["versions"][0].items()
        if package != "jbrep"
    )
    first = (
        f"In a checkout of jbrep {tables.record['versions'][0]['jbrep']}, with these versions (the "
        "same bits need the same kind of processor, too):",
        f"pip install '.[learn]' {versions}",
    )
    report = ("The tables, figures and this page from the runs:", f"jbrep report {tables.name}")
    study = tables.record["study"]
    if study:
        toml = ("This file, as study.toml:", _toml(study))
        return [first, toml, ("All runs:", f"jbrep study study.toml --out {tables.name}"), report]
    commands = "\n".join(
        _command(shared, f"{tables.name}/{label}/seed-0")
        for label, shared in tables.record["labels"].items()
    )
    return [first, ("Each run; these are of one seed:", commands), report]


def _toml(study: Mapping[str, Any]) -> str:
    """A study as the file that it came from says it."""
    lines, below = [], []
    for name, value in study.items():
        if isinstance(value, Mapping):
            cells = [
                f"{key} = {json.dumps(each)}" for key, each in value.items() if each not in ("", 0)
            ]
            below += ["", f"[{name}]", *cells] if cells else []
        elif value is not None:
            lines.append(f"{name} = {json.dumps(value)}")
    return "\n".join(lines + below)


def _command(shared: Mapping[str, Any], out: str) -> str:
    settings = shared["settings"]
    options = ("task", "algorithm", "preset", "steps", "evaluate_every", "evaluation_episodes")
    given = " ".join(f"--{name.replace('_', '-')} {settings[name]}" for name in options)
    return f"jbrep rl {given} --encoder {shared['encoder']['name']} --seed 0 --out {out}"
