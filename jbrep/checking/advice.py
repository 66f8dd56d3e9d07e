"""The representation to begin with, and the features file that says what was found."""

import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import asdict

from jbrep.checking.features import Shapes
from jbrep.checking.findings import Finding
from jbrep.checking.seen import Seen
from jbrep.coordinates import make_coordinates
from jbrep.envs.names import modules_of
from jbrep.envs.task import Feature, Task
from jbrep.envs.view import with_view
from jbrep.errors import InputError
from jbrep.records.document import toml_text
from jbrep.text import words

_USUAL = 0.01, 0.99  # quantiles of what was seen: a usual range, where none is known
_UNWANTED = "constant", "copy", "world"  # kinds of findings whose features can be left out
_FILE = "features.toml"  # what commands call it unless it is written


class Advice(NamedTuple):
    """What to begin with."""

    representation: str
    why: str
    command: str
    features: tuple[Feature, ...]  # of all that the environment gives, as found


def advise(
    seen: Seen,
    shapes: Shapes,
    findings: Sequence[Finding],
    joints: Mapping[str, str],
    is_symmetric: bool,
    where: Path | None,
    data: Path | None,
) -> Advice:
    """Choose a representation, and write its command.

    Args:
        seen: what was played or read.
        shapes: what its features are like.
        findings: what is to be changed.
        joints: names of features.
        is_symmetric: whether turning and shifting was tried and changes nothing.
        where: the features file, if it is written.
        data: the folder of the data set that was read, if one was.
    """
    task = seen.task
    features = _found(seen, shapes, joints)
    needed = any(
        (new.kind, new.frame) != (old.kind, old.frame)
        for new, old in zip(features, task.whole.features, strict=True)
    ) or any(each.kind == "scales" for each in findings)
    use_file = needed or where is not None
    known = task.whole.replace(features=features) if use_file else task.whole
    new_names = dict(zip(task.whole.feature_names, known.feature_names, strict=True))
    unwanted = [
        new_names.get(name, name)
        for each in findings
        if each.kind in _UNWANTED and not (each.kind == "world" and is_symmetric)
        for name in each.features[: 1 if each.kind == "copy" else None]
    ]
    before = task.view.hidden if task.view else ()
    hidden = [*dict.fromkeys((*(new_names[name] for name in before), *unwanted))]
    steps = [each.numbers["history"] for each in findings if "history" in each.numbers]
    history = max(steps, default=task.view.history if task.view else 1)
    system, why = _system(known, hidden, history, findings, is_symmetric)
    options = [f"--features={where or _FILE}"] * use_file
    seen_options = [f"--hide={name}" for name in hidden]
    seen_options += [f"--history={history}"] * (history > 1)
    if data is None:
        named = ["--task", task.name, *(f"--import={each}" for each in modules_of(task))]
        named += [f"--env={each}" for each in task.given_arguments]
        line = ["rl", *named, *options, *seen_options, "--encoder", system, "--out", "runs/first"]
        commands = [line]
    else:
        again = [["data", "import", "...", *options, "--out", f"{data}-again"]] * use_file
        now = f"{data}-again" if use_file else str(data)
        derive = ["data", "derive", now, *seen_options, "--out", f"{data}-seen"]
        now = f"{data}-seen" if seen_options else now
        kind = ["--kind", system] if system != "full" else ["--kind", "identity"]
        train = ["train-encoder", *kind, "--data", now, "--out", "encoders"]
        commands = [*again, *([derive] if seen_options else []), train]
    command = "\n".join(shlex.join(["jbrep", *each]) for each in commands)
    return Advice(system, why, command, features)


def _system(
    task: Task,
    hidden: Collection[str],
    history: int,
    findings: Sequence[Finding],
    is_symmetric: bool,
) -> tuple[str, str]:
    if is_symmetric:
        return "symmetry", "turning and shifting the robot was tried and changes nothing"
    kinds = {each.kind for each in task.features}
    reasons = {
        "angles jump": any(each.is_full_turn for each in task.features),
        "a quaternion has two signs": "quaternion" in kinds,
        "offsets have a length and a direction": "offset" in kinds,
    }
    why = next((name for name, holds in reasons.items() if holds), None)
    try:
        if why and make_coordinates(with_view(task, hidden, history), "coordinates"):
            return "coordinates", why
    except InputError:
        pass
    if any(each.kind == "scales" for each in findings):
        return "full", "scaled by the usual ranges of the features file"
    return "full", "no feature jumps"


# features as found


def _found(seen: Seen, shapes: Shapes, joints: Mapping[str, str]) -> tuple[Feature, ...]:
    """All features that the environment gives, with what was found of those that are seen."""
    task = seen.task
    renamed = words(joints.get(name, name) for name in task.whole.feature_names)
    places = {name: i for i, name in enumerate(task.feature_names)}
    quaternions = {
        task.feature_names[first + k]: f"attitude{n or ''}"
        for n, first in enumerate(shapes.quaternions)
        if task.features[first].kind == "scalar" and _is_w_first(seen, first)
        for k in range(4)
    }
    made, parts, last = list[Feature](), dict[str, int](), ""
    for old, name in zip(task.whole.features, renamed, strict=True):
        group = quaternions.get(old.name, old.group)
        if quaternions and group:  # what a quaternion parts is two groups
            parts[group] = parts.get(group, 0) + (group != last)
            last = group
            group = group if parts[group] == 1 else f"{group}.{parts[group]}"
        new = old.replace(name=name, group=group)
        if old.name in quaternions:
            new = new.replace(kind="quaternion", low=-1.0, high=1.0, bounded=True)
        elif old.name in places:
            new = _as_seen(new, seen, shapes, places[old.name])
        made.append(new)
    return tuple(made)


def _is_w_first(seen: Seen, first: int) -> bool:
    return bool((seen.before[:, first : first + 4] ** 2).mean(axis=0).argmax() != 3)


def _as_seen(feature: Feature, seen: Seen, shapes: Shapes, i: int) -> Feature:
    turn = shapes.turns.get(i)
    if turn and turn.is_radian and feature.kind == "scalar":
        low, high = turn.low, turn.low + turn.size
        return feature.replace(kind="angle", unit="rad", low=low, high=high, bounded=True)
    low, high = (float(f"{end:.3g}") for end in np.quantile(seen.before[:, i], _USUAL))
    if feature.is_angle or feature.low is not None or feature.high is not None or low >= high:
        return feature
    return feature.replace(low=low, high=high)


def features_toml(task: Task, features: Sequence[Feature], findings: Sequence[Finding]) -> str:
    """The file of a task's features as found, with what is to be changed as comments."""
    lines = [
        f"# The features of {task.name} as jbrep check found them. Correct names, units and usual",
        "# ranges; docs/coordinates.md says what kinds and frames are.",
    ]
    for old, new in zip(task.whole.features, features, strict=True):
        lines += ["", *([f"# {old.name}"] if old.name != new.name else [])]
        lines += [f"# {each.title}: {each.evidence}" for each in findings if old.name in each.features]
        said = {name: value for name, value in asdict(new).items() if value not in (None, "", False)}
        lines += ["[[features]]", toml_text({"unit": "", **said}).rstrip()]
    return "\n".join(lines) + "\n"
