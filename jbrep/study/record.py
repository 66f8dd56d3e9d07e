"""What was run, in one file: every run, the settings under each label, the unfinished runs."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jbrep.encoders import FULL, Encoder, load
from jbrep.rl.files import ENCODER, read_run
from jbrep.stats.runs import in_order
from jbrep.study.plan import read_plan
from jbrep.study.work import read_progress

RECORD = "runs.json"
FORMAT = "jbrep runs"
FORMAT_VERSION = 1


def record(folder: Path, folders: Sequence[Path], left_out: Sequence[str]) -> dict[str, Any]:
    """What was run, as plain JSON.

    Args:
        folder: of a study, or any folder with runs below it.
        folders: of the runs that have finished or failed.
        left_out: what the statistics leave out, in sentences.

    Raises:
        InputError: a file is damaged.
    """
    runs = {each: read_run(each) for each in folders}
    order = in_order((run["settings"]["representation"] for run in runs.values()), FULL)
    runs = dict(sorted(runs.items(), key=lambda item: _sort_key(item[1]["settings"], order)))
    labels: dict[str, Any] = {}
    for each, run in runs.items():
        label = run_label(run["settings"])
        if label not in labels:
            labels[label] = _shared(run["settings"], load(each / ENCODER))
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **_study(folder),
        "left_out": list(left_out),
        "versions": _distinct(run["versions"] for run in runs.values()),
        "processors": _distinct(run["cpu"] for run in runs.values()),
        "labels": labels,
        "runs": [
            {
                "label": run_label(run["settings"]),
                "seed": run["settings"]["seed"],
                **{name: run.get(name) for name in ("status", "reason", "steps", "seconds")},
            }
            for run in runs.values()
        ],
    }


def _sort_key(settings: Mapping[str, Any], order: list[str]) -> tuple[Any, ...]:
    """By task, algorithm, representation (in the order of tables) and seed."""
    representation = order.index(settings["representation"])
    return settings["task"], learner(settings), representation, settings["seed"]


def run_label(settings: Mapping[str, Any]) -> str:
    """Task, algorithm with its preset, representation: face_direction/sac-modern/dae-8."""
    return f"{settings['task']}/{learner(settings)}/{settings['representation']}"


def learner(settings: Mapping[str, Any]) -> str:
    """The algorithm with its preset, unless that is the paper's: ddpg, sac-modern."""
    suffix = "" if settings["preset"] == "paper" else f"-{settings['preset']}"
    return settings["algorithm"] + suffix


def as_json(contents: Mapping[str, Any]) -> bytes:
    """The contents of the file."""
    return (json.dumps(contents, indent=1, allow_nan=False) + "\n").encode()


def _shared(settings: Mapping[str, Any], encoder: Encoder) -> dict[str, Any]:
    """What the runs of a label share: everything but the seed."""
    return {
        "settings": {name: value for name, value in settings.items() if name != "seed"},
        "encoder": {
            "name": encoder.name,
            "size": encoder.size,
            **{
                part: [[len(layer.bias), layer.activation] for layer in getattr(encoder, part)]
                for part in ("encoder", "decoder")
            },
            **{name: encoder.header[name] for name in ("kind", "training", "data", "metrics")},
        },
    }


def _study(folder: Path) -> dict[str, Any]:
    """The study, and the steps done by each of its unfinished runs."""
    plan = read_plan(folder)
    if plan is None:
        return {"study": None, "missing": {}}
    return {
        "study": plan.as_json(),
        "missing": {c.name: read_progress(plan.folder_of(c))[0] for c in plan.unfinished},
    }


def _distinct(values: Any) -> list[Any]:
    distinct: list[Any] = []
    for value in values:
        if value not in distinct:
            distinct.append(value)
    return distinct
