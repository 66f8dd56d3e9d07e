"""What was run, as one file: every run, what its label shares, what is missing of the study."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jbrep.encoders import FULL, Encoder, load
from jbrep.rl.files import ENCODER, read_run
from jbrep.rl.run import plain
from jbrep.stats.runs import in_order
from jbrep.study.plan import read_plan
from jbrep.study.work import read_progress

RECORD = "runs.json"
FORMAT = "jbrep runs"
FORMAT_VERSION = 1


def record(folder: Path, folders: Sequence[Path], left_out: Sequence[str]) -> dict[str, Any]:
    """What was run, as plain JSON.

    Args:
        folder: of a study, or any above runs.
        folders: of the runs that are over.
        left_out: what the statistics leave out, in words.

    Raises:
        InputError: a file is damaged.
    """
    read = {each: read_run(each) for each in folders}
    order = in_order((run["settings"]["representation"] for run in read.values()), FULL)
    read = dict(sorted(read.items(), key=lambda item: _place(item[1]["settings"], order)))
    labels: dict[str, Any] = {}
    for each, run in read.items():
        label = run_label(run["settings"])
        if label not in labels:
            labels[label] = _shared(run["settings"], load(each / ENCODER))
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **_study(folder),
        "left_out": list(left_out),
        "versions": _different(run["versions"] for run in read.values()),
        "processors": _different(run["cpu"] for run in read.values()),
        "labels": labels,
        "runs": [
            {
                "label": run_label(run["settings"]),
                "seed": run["settings"]["seed"],
                **{name: run.get(name) for name in ("status", "reason", "steps", "seconds")},
            }
            for run in read.values()
        ],
    }


def _place(settings: Mapping[str, Any], order: list[str]) -> tuple[Any, ...]:
    """By task and algorithm, then as tables have representations, then seeds."""
    representation = order.index(settings["representation"])
    return settings["task"], learner(settings), representation, settings["seed"]


def run_label(settings: Mapping[str, Any]) -> str:
    """Task, algorithm with its preset, representation: face_direction/sac-modern/dae-8."""
    return f"{settings['task']}/{learner(settings)}/{settings['representation']}"


def learner(settings: Mapping[str, Any]) -> str:
    """The algorithm; a preset other than the paper's follows."""
    suffix = "" if settings["preset"] == "paper" else f"-{settings['preset']}"
    return settings["algorithm"] + suffix


def as_json(found: Mapping[str, Any]) -> bytes:
    """A record as it is kept."""
    return (json.dumps(found, indent=1, allow_nan=False) + "\n").encode()


def _shared(settings: Mapping[str, Any], encoder: Encoder) -> dict[str, Any]:
    """What all runs of a label share: all but the seed."""
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
    """What was asked for, and what of it isn't over: steps done by run."""
    plan = read_plan(folder)
    if plan is None:
        return {"study": None, "missing": {}}
    left = [cell for cell in plan.cells if not plan.is_over(cell)]
    return {
        "study": plain(asdict(plan.study)),
        "missing": {cell.name: read_progress(plan.folder_of(cell))[0] for cell in left},
    }


def _different(values: Any) -> list[Any]:
    found: list[Any] = []
    for value in values:
        if value not in found:
            found.append(value)
    return found
