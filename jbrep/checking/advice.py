"""The representation to begin with, and the features file that says what was found."""

import shlex
import warnings
from collections.abc import Sequence
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import asdict

from jbrep.checking.features import TURNS, Finding, Shapes
from jbrep.checking.transitions import Transitions
from jbrep.coordinates import make_coordinates
from jbrep.envs.description import describe
from jbrep.envs.names import modules_of, spec_of
from jbrep.envs.probe import Bounds
from jbrep.envs.task import Feature, Task
from jbrep.envs.view import with_view
from jbrep.errors import InputError
from jbrep.records.document import toml_text

# what a features file says
_OF_TASK = "timestep", "reward_low", "reward_high", "solved_return"
_declared = attrgetter("features", "offsets", *_OF_TASK)
_USUAL = 0.01, 0.99  # quantiles of what was seen: a usual range, where none is known


class Advice(NamedTuple):
    """What to begin with: a representation, and the features (D,) of the environment, as found."""

    representation: str
    why: str
    command: str
    features: tuple[Feature, ...]


def advise(
    seen: Transitions,
    shapes: Shapes,
    findings: Sequence[Finding],
    is_symmetric: bool,
    where: Path | None,
    data: Path | None,
) -> Advice:
    """Choose a representation for what was found, and write its command.

    `where` is the features file that was written, `data` the folder that was read.
    """
    task, features = seen.task, _found(seen, shapes)
    default = None if data else _undescribed(task)
    baseline = task.whole if data else default or _undescribed(task, _bounds(task)) or task.whole
    kinds = [[(e.name, e.kind, e.frame) for e in some] for some in (features, task.whole.features)]
    scales = any(each.kind == "scales" for each in findings)
    use_file = bool(
        where or kinds[0] != kinds[1] or _declared(task.whole) != _declared(baseline) or scales
    )
    known = task.whole.replace(features=features) if use_file else task.whole
    steps = [each.numbers["history"] for each in findings if "history" in each.numbers]
    history = max([*steps, task.view.history if task.view else 1])
    is_symmetric = is_symmetric and history == 1  # with more there is no "symmetry"
    hidden = [*(task.view.hidden if task.view else ())]
    for each in findings:
        is_copied = each.kind == "copy" and not {*hidden}.isdisjoint(each.features)
        if is_copied or (each.kind == "world" and not is_symmetric):
            known_names = {*task.whole.feature_names}.difference(hidden)
            hidden += [name for name in each.features if name in known_names]
    system, why = ("symmetry", "turning and shifting it was tried: nothing else changes")
    if not is_symmetric:
        winds = any(each.kind == "winds" for each in findings)
        system, why = _system(with_view(known, hidden, history), winds)
    view = [f"--hide={name}" for name in hidden] + [f"--history={history}"] * (history > 1)
    if data is None:
        file = [f"--features={where or 'features.toml'}"] * use_file
        given = [*_given(task, default), *file, *view]
        commands = [["rl", *given, "--encoder", system, "--out", "runs/first"]]
        if use_file and not where:
            commands.insert(0, ["check", *_given(task, default)[1:], "--write", "features.toml"])
    else:
        if kinds[0] != kinds[1]:
            why += f"; first make the data anew with --features {where or 'features.toml'}"
        derive = view and not task.view  # what is derived can't be derived from again
        derived = f"{data}-seen" if derive else str(data)
        commands = [["data", "derive", str(data), *view, "--out", derived]] if derive else []
        commands += [["train-encoder", "--kind", system, "--data", derived, "--out", "encoders"]]
    command = "\n".join(shlex.join(["jbrep", *each]) for each in commands)
    return Advice(system, why, command, features)


def _given(task: Task, own: Task | None) -> list[str]:
    """What names a task on a command line, with what its `own` environment doesn't say."""
    options = ["--task", task.name.removesuffix(task.view.suffix if task.view else "")]
    options += [f"--import={each}" for each in modules_of(task)]
    options += [f"--env={each}" for each in task.given_arguments]
    if spec_of(task).max_episode_steps != task.max_episode_steps:
        options.append(f"--episode-steps={task.max_episode_steps}")
    if own is None or _bounds(own) != _bounds(task):
        bounds = [f"{a:.9g}..{b:.9g}" for a, b in _bounds(task)]
        options.append(f"--action-bounds={','.join(bounds if len({*bounds}) > 1 else bounds[:1])}")
    return options + [f"--missing={task.missing}"] * bool(task.missing)


def _undescribed(task: Task, bounds: Bounds = ()) -> Task | None:
    """The task as its environment describes itself; None where that can't be a task."""
    with suppress(InputError), warnings.catch_warnings(action="ignore"):
        return describe(task.id, task.arguments, task.max_episode_steps, action_bounds=bounds)
    return None


def _bounds(task: Task) -> Bounds:
    return tuple(zip(task.action_low, task.action_high, strict=True))


def _system(task: Task, winds: bool) -> tuple[str, str]:
    """Coordinates where features jump or are longer and turned, else all features."""
    kinds = {each.kind for each in task.features}
    reasons = {
        "angles jump where they wrap": any(each.is_full_turn for each in task.features),
        "angles wind beyond a full turn": winds,
        "a quaternion has two signs": "quaternion" in kinds,
        "offsets have a length and a direction": "offset" in kinds,
    }
    try:
        why = next((name for name, holds in reasons.items() if holds), "")
        if why and make_coordinates(task, "coordinates"):
            return "coordinates", why
    except InputError:
        pass
    return "full", "as features are declared, coordinates change nothing"


def _found(seen: Transitions, shapes: Shapes) -> tuple[Feature, ...]:
    """All features that the environment gives, with what was found of those that are seen."""
    task, before = seen.task, ""
    places = {name: i for i, name in enumerate(task.feature_names)}
    turned = [first for first in shapes.quaternions if task.features[first].kind == "scalar"]
    made, parts = list[Feature](), dict[str, int]()
    for old in task.whole.features:
        i = places.get(old.name, -1)
        first = next((first for first in turned if first <= i < first + 4), None)
        new = old if i < 0 else _as_seen(old, seen, shapes, i)
        group = old.group if first is None else f"attitude{first}"
        if first is not None:
            new = new.replace(low=-1.0, high=1.0, bounded=True)
        parts[group] = parts.get(group, 0) + (group != before)
        before = group
        # what a quaternion parts is two groups
        is_second = turned and group and parts[group] > 1
        made.append(new.replace(group=f"{group}.{parts[group]}" if is_second else group))
    return tuple(made)


def _as_seen(feature: Feature, seen: Transitions, shapes: Shapes, i: int) -> Feature:
    turn = shapes.turns.get(i)
    if turn and turn[:2] in TURNS[:2] and feature.kind == "scalar":
        low, high = turn.low, turn.low + turn.size
        return feature.replace(kind="angle", unit="rad", low=low, high=high, bounded=True)
    low, high = ends = np.quantile(seen.before[:, i], _USUAL).tolist()
    if low < high:  # three digits of the range
        low, high = np.round(ends, 2 - int(np.floor(np.log10(high - low)))).tolist()
    if feature.is_angle or feature.low is not None or feature.high is not None or low >= high:
        return feature
    return feature.replace(low=low, high=high)


def features_toml(task: Task, features: Sequence[Feature], findings: Sequence[Finding]) -> str:
    """The file of a task's features as found, with what is to be changed as comments."""
    lines = [
        f"# The features of {task.name} as jbrep check found them. Correct names, units and usual",
        "# ranges; docs/coordinates.md says what kinds and frames are.",
    ]
    known = {name: getattr(task, name) for name in _OF_TASK}
    lines.append(toml_text({k: v for k, v in known.items() if v is not None}).rstrip())
    for old, new in zip(task.whole.features, features, strict=True):
        comments = [
            f"# {each.kind}: {each.evidence}; {each.fix}"
            for each in findings
            if old.name in each.features
        ]
        every = {**asdict(new), "offset": (task.offsets or {}).get(old.name)}
        said = {k: v for k, v in every.items() if v is not None and v is not False and v != ""}
        lines += ["", *comments, "[[features]]", toml_text({"unit": "", **said}).rstrip()]
    return "\n".join(lines) + "\n"
