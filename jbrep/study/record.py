"""What was run, in one file: every run, the settings under each label, the unfinished runs."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jbrep.encoders import FULL, load
from jbrep.encoders.base import OWN
from jbrep.envs.task import read_task
from jbrep.records.storage import exists
from jbrep.rl.files import ENCODER
from jbrep.rl.names import base_name
from jbrep.stats.runs import in_order
from jbrep.study.plan import Plan, read_plan
from jbrep.study.registration import deviations
from jbrep.study.work import read_progress

RECORD = "runs.json"
FORMAT = "jbrep runs"
FORMAT_VERSION = 1
EACH_ITS_OWN = "runs have different encoders"
_RECORDS = ("training", "data", "metrics")  # of an encoder


def record(
    folder: Path, ended: Mapping[Path, Mapping[str, Any]], left_out: Sequence[str]
) -> dict[str, Any]:
    """What was run, as plain JSON.

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
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **_study(folder, {run_name(run["settings"]): run for run in runs.values()}),
        "left_out": list(left_out),
        "versions": _distinct(run["versions"] for run in runs.values()),
        "processors": _distinct(run["cpu"] for run in runs.values()),
        "labels": {label: _shared(of_label) for label, of_label in labels.items()},
        "runs": [
            {
                "label": run_label(run["settings"]),
                **{name: run["settings"][name] for name in ("seed", "encoder", "encoder_seed")},
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
    """Task, learner, representation: face_direction/sac-modern/dae-8."""
    return f"{settings['task']}/{learner(settings)}/{settings['representation']}"


def run_name(settings: Mapping[str, Any]) -> str:
    """The same with the seed: face_direction/sac-modern/dae-8/seed-0."""
    return f"{run_label(settings)}/seed-{settings['seed']}"


def learner(settings: Mapping[str, Any]) -> str:
    """What tables call the algorithm with its settings: ddpg, sac-modern, my-sac."""
    return settings.get("learner") or base_name(settings["algorithm"], settings["preset"])


def as_json(contents: Mapping[str, Any]) -> bytes:
    """The contents of the file."""
    return (json.dumps(contents, indent=1, allow_nan=False) + "\n").encode()


def shared_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that all runs of a label share: without the seed and what depends on it."""
    own = ("seed", "encoder_seed", "registration")
    shared = {name: value for name, value in settings.items() if name not in own}
    if settings["encoder_seed"] is not None:
        shared["encoder"] = EACH_ITS_OWN
    if settings["from"] is not None:
        shared["from"] = "another run's policy"
    return shared


def _shared(runs: Mapping[Path, Mapping[str, Any]]) -> dict[str, Any]:
    """What the runs of a label share, by folder."""
    settings = shared_settings(next(iter(runs.values()))["settings"])
    folders = list(runs) if settings["encoder"] == EACH_ITS_OWN else list(runs)[:1]
    return {"settings": settings, "encoder": _common(_encoder(f, runs[f]) for f in folders)}


def _encoder(folder: Path, run: Mapping[str, Any]) -> dict[str, Any]:
    """What is known of a run's encoder; of a user's own, its sizes alone."""
    settings: Mapping[str, Any] = run["settings"]
    if "latent_size" in run and not exists(folder / ENCODER):
        return {
            "name": settings["encoder_code"] or "an object in Python",
            "kind": OWN,
            "size": read_task(settings["environment"]).size,
            "latent_size": run["latent_size"],
            **{part: [] for part in ("encoder", "decoder")},
            **{name: {} for name in _RECORDS},
        }
    encoder = load(folder / ENCODER)
    return {
        **{name: getattr(encoder, name) for name in ("name", "kind", "size", "latent_size")},
        **{
            part: [[len(layer.bias), layer.activation] for layer in getattr(encoder, part)]
            for part in ("encoder", "decoder")
        },
        **{name: encoder.header[name] for name in _RECORDS},
    }


def _common(encoders: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What is the same of all encoders; empty where nothing is."""
    first, *others = encoders
    common = {
        name: value if all(each[name] == value for each in others) else type(value)()
        for name, value in first.items()
    }
    for name in _RECORDS:
        fields = first[name].items()
        common[name] = {n: v for n, v in fields if all(each[name].get(n) == v for each in others)}
    return common


def _study(folder: Path, runs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The study, its registration, and the steps done by each of its unfinished runs."""
    plan = read_plan(folder)
    if plan is None:
        return {"study": None, "registration": None, "missing": {}}
    return {
        "study": plan.as_json(),
        "registration": _registration(plan, runs),
        "missing": {c.name: read_progress(plan.folder_of(c))[0] for c in plan.unfinished},
    }


def _registration(plan: Plan, runs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any] | None:
    """When a study was registered, and how what ran differs from that; None if it wasn't."""
    if plan.registration is None:
        return None
    differing = deviations(plan.registration, plan.as_json(), runs)
    facts = {name: plan.registration[name] for name in ("sha256", "date")}
    return {**facts, "deviations": differing}


def _distinct(values: Any) -> list[Any]:
    distinct: list[Any] = []
    for value in values:
        if value not in distinct:
            distinct.append(value)
    return distinct
