"""What an environment is: described by itself or found out, with what a user says of it."""

import json
import warnings
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET
from msgspec.structs import asdict

from jbrep.envs.domain import PHYSICS, SIGNALS, Domain, read_ranges
from jbrep.envs.environments import Environments
from jbrep.envs.isolation import isolated
from jbrep.envs.make import creator, give_back, is_batched, take
from jbrep.envs.names import absolute, code_of, files_of, find_spec, spec_of, taken_for
from jbrep.envs.physics import can_be_pushed, physics_of
from jbrep.envs.probe import Bounds, Signals, precision_problems, probe, within
from jbrep.envs.task import EpisodeSteps, Frame, Kind, Task, Word
from jbrep.envs.view import with_view
from jbrep.errors import InputError, Notice, refusing
from jbrep.records.document import read_toml
from jbrep.records.keys import checked
from jbrep.records.record import Finite, Record, converted, from_plain, to_plain

_SPREAD_EPISODES = 5  # of random actions


@checked
def describe(
    name: Any,
    env: Mapping[str, Any] | None = None,
    episode_steps: int | None = None,
    features: Path | str | Mapping[str, Any] | None = None,
    missing: str | None = None,
    hide: Iterable[str] = (),
    history: int = 1,
    domain: Mapping[str, Any] | None = None,
    action_bounds: Bounds | str | None = None,
) -> Task:
    """Describe a task: its environment is made and played for some steps.

    An environment class may describe itself: its static method `describe`, given the arguments
    and the time limit or None, returns the `Task`; nothing is played then.

    Args:
        name: one of the Jitterbug's tasks, an id in Gymnasium's registry, or an environment: its
            class, or an instance, which exists in this process alone.
        env: arguments of the environment, plain JSON; files that they name become absolute paths.
        episode_steps: the time limit; the registered one if not given.
        features: a TOML file with names, units, ranges, kinds and offsets, see
            docs/robot.md, or what it would hold.
        missing: what becomes of readings that aren't finite, see `Task`; by default an error.
        hide: what isn't seen of it, see `jbrep.envs.view.with_view`.
        history: states that are seen at once, see there.
        domain: numbers and ranges from which each episode draws, such as {"delay": "0..2"}, see
            `jbrep.envs.domain.Domain`.
        action_bounds: of all numbers of an action, (-1, 1) or "-1..1", or of each: "-1..1,0..5".
            Within the environment's own; they must be given where that has none.
    """
    name, made_with, limit = taken_for(name)
    episode_steps = limit if episode_steps is None else episode_steps
    spec, given = find_spec(name), absolute({**made_with, **(env or {})})
    if "max_episode_steps" in given:
        raise InputError(
            f"max_episode_steps is no argument of {spec.id}: `episode_steps` sets the time limit"
        )
    bounds = read_bounds(action_bounds)
    every = {**spec.kwargs, **given}
    files = files_of(every)
    registered = spec.max_episode_steps, spec.reward_threshold, repr(spec.kwargs)
    with refusing(f"can't make {spec.id}"):
        maker = creator(spec)
    key = (maker, tuple(code_of(maker).items()), registered, tuple(files.items()))
    with refusing("`env` must be plain JSON, such as text and numbers"):
        arguments = json.dumps(given, sort_keys=True)
    task, signals = _describe(name, arguments, episode_steps, bounds, key)
    now = files_of(every)  # the environment may write one of them, such as a log
    kept = {file: digest for file, digest in files.items() if now.get(file) == digest}
    if own := kept | code_of(maker):
        task = task.replace(files=own)
    task = with_features(task, features) if features is not None else task
    hide = (hide,) if isinstance(hide, str) else hide
    for problem in precision_problems(task, signals):
        warnings.warn(problem, Notice, stacklevel=2)
    task = task.replace(missing=missing) if missing else task
    return with_domain(with_view(task, hide, history), domain or {})


def as_task(given: Any) -> Task:
    """A task, or what `describe` takes for one, described."""
    return given if isinstance(given, Task) else describe(given)


def read_bounds(given: Bounds | str | None) -> Bounds:
    """Bounds of actions as people write them: "-1..1", or "-1..1,0..5", one for each number."""
    parts: Any = given.tolist() if isinstance(given, np.ndarray) else given or ()
    if isinstance(parts, str):
        parts = [each.split("..") for each in parts.split(",")]
    elif parts and not (np.iterable(parts) and any(map(np.iterable, parts))):
        parts = [parts]
    return converted(parts, Bounds, "action_bounds", strict=False)


@lru_cache(maxsize=64)
def _describe(
    name: str, arguments: str, max_episode_steps: int | None, bounds: Bounds, key: tuple[Any, ...]
) -> tuple[Task, Signals | None]:
    """The task, and what its features went through where it was played.

    Arguments are in JSON here, and the key is which environment has that name now.
    """
    spec, given = find_spec(name), json.loads(arguments)
    if max_episode_steps is not None:
        converted(max_episode_steps, EpisodeSteps, "the number of steps in an episode")
    with refusing(f"{spec.id} failed when it was tried"), isolated():
        own = getattr(creator(spec), "describe", None)
        if own is None:
            return probe(spec.id, given, max_episode_steps, bounds)
        described = own({**spec.kwargs, **given}, max_episode_steps)
        if not (isinstance(described, Task) and described.id == spec.id):
            raise TypeError(f"describe must return a jbrep.envs.Task with the id {spec.id}")
        if bounds:
            low, high = within(described.id, described.action_low, described.action_high, bounds)
            described = described.replace(action_low=low.tolist(), action_high=high.tolist())
        return described, None


# what a user's file says


class _FeatureChanges(Record, frozen=True):
    """What a TOML file says of a feature."""

    name: Word | None = None
    unit: str | None = None
    low: Finite | None = None
    high: Finite | None = None
    group: Word | None = None
    bounded: bool | None = None
    kind: Kind | None = None
    frame: Frame | None = None
    offset: Finite | None = None


class _TaskChanges(Record, frozen=True):
    """What it says of a task."""

    timestep: Finite | None = None
    reward_low: Finite | None = None
    reward_high: Finite | None = None
    solved_return: Finite | None = None
    features: tuple[_FeatureChanges, ...] | None = None


def with_features(task: Task, said: Path | str | Mapping[str, Any]) -> Task:
    """The task with what a TOML file, or a table, says of its features and rewards."""
    given = said if isinstance(said, Mapping) else read_toml(Path(said))
    try:
        changes = from_plain(given, _TaskChanges)
        rows = changes.features
        if rows is not None and len(rows) != task.size:
            raise InputError(f"it must have a [[features]] for each of the {task.size} features")
        names = [row.name or own for row, own in zip(rows or (), task.feature_names, strict=False)]
        moved = [n for n, own in zip(names, task.feature_names, strict=False) if n != own]
        if len({*names}) == len(names) and (others := {*moved} & {*task.feature_names}):
            raise InputError(f"{min(others)} is in another place: keep the order of the features")
        turned = [n for n, row in zip(names, rows or (), strict=False) if row.kind == "quaternion"]
        if "".join(each[-1] for each in turned[:4]).lower() == "xyzw":
            raise InputError(f"a quaternion is w, x, y, z: {turned[0]} comes first; reorder them")
        features, offsets = list(task.features), {}
        for i, row in enumerate(rows or ()):
            own = _said(row)
            known = (task.offsets or {}).get(features[i].name, 0.0)
            offset = own.pop("offset", known)
            ends = {name: getattr(features[i], name) for name in ("low", "high")}
            left = {name: end + known - offset for name, end in ends.items() if end is not None}
            features[i] = features[i].replace(**left | own)
            if offset:
                offsets[features[i].name] = offset
        declared = {**_said(changes), "features": features}
        if rows:
            declared["offsets"] = offsets or UNSET
        return task.replace(**declared)
    except InputError as error:
        where = "features" if isinstance(said, Mapping) else said
        raise InputError(f"{where} can't be used for {task.name}: {error}") from None


def _said(changes: Record) -> dict[str, Any]:
    return {name: value for name, value in asdict(changes).items() if value is not None}


# domains


def with_domain(task: Task, given: Mapping[str, Any]) -> Task:
    """The task whose episodes draw from ranges, as `read_ranges` takes them; {} for none."""
    if not given:
        return task.undisturbed
    ranges, known = read_ranges(given), changeable(task)
    if unknown := [name for name in ranges if name not in known]:
        raise InputError(
            f"{unknown[0]} can't be changed in {task.name}: it must be one of {', '.join(known)}"
        )
    if "noise" in ranges and ranges["noise"][1]:
        ranges["spread"] = spread(task)
    return task.replace(domain=Domain(**ranges))


def changeable(task: Task) -> tuple[str, ...]:
    """What of an environment a domain may have: with MuJoCo friction, mass and, mostly, pushes."""
    if is_batched(task):
        own = getattr(creator(spec_of(task), vector=True), "changeable", ())
        return (*SIGNALS, *own)
    env = take(task.id, task.arguments, task.max_episode_steps)
    physics = physics_of(env)
    can_push = physics and can_be_pushed(physics.model)
    own = [name for name in PHYSICS if name != "push" or can_push] if physics else []
    give_back(env)
    return (*SIGNALS, *own)


def spread(task: Task) -> tuple[float, ...]:
    """The standard deviation of each feature in episodes of random actions, (D,)."""
    made = creator(spec_of(task))  # a class may be defined anew
    return _spread(json.dumps(to_plain(task.whole.undisturbed), sort_keys=True), made)


@lru_cache(maxsize=8)
def _spread(plain: str, made: Any) -> tuple[float, ...]:
    task = from_plain(json.loads(plain), Task)
    several = _SPREAD_EPISODES if is_batched(task) else 1
    low, high = task.action_low, task.action_high
    seen = []
    with Environments(task, several) as envs:
        for first in range(0, _SPREAD_EPISODES, several):
            seeds = range(first, first + several)
            randoms = [np.random.default_rng(seed) for seed in seeds]
            seen.append(envs.reset(range(several), seeds))
            while envs.num_active:
                active = envs.active
                step = envs.step([random.uniform(low, high) for random in randoms])
                seen.append(step.observation[active])
    return tuple(np.concatenate(seen).std(axis=0).tolist())
