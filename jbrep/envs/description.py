"""What an environment is, found out by making it once."""

import json
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten_space
from msgspec.structs import asdict
from numpy.typing import NDArray

from jbrep.envs import instances
from jbrep.envs.infos import number_of
from jbrep.envs.make import action_in, aside, creator, random_play, reason
from jbrep.envs.mujoco import with_kinds
from jbrep.envs.names import find_spec
from jbrep.envs.origin import absolute, code_of, files_of
from jbrep.envs.precision import Signals, precision_problems
from jbrep.envs.randomized import with_domain
from jbrep.envs.task import (
    MAX_FEATURES,
    NARROW_SEEDS,
    WIDE_SEEDS,
    EpisodeSteps,
    Feature,
    Frame,
    Kind,
    SeedBits,
    Task,
    Word,
)
from jbrep.envs.view import with_view
from jbrep.errors import InputError, Notice, refusing
from jbrep.records.record import Finite, Record, converted, from_plain
from jbrep.records.toml import read_toml
from jbrep.text import words

_PROBE_STEPS = 200  # of each instance whose episodes are compared
_LONGEST_PROBE = 10_000  # steps in search of a time limit


def describe(
    name: str,
    arguments: Mapping[str, Any] | None = None,
    max_episode_steps: int | None = None,
    features: Path | None = None,
    missing: str | None = None,
    hidden: Iterable[str] = (),
    history: int = 1,
    domain: Mapping[str, Any] | None = None,
) -> Task:
    """Describe a task: its environment is made and played for some steps.

    An environment class may describe itself: its static method `describe`, given the arguments
    and the time limit or None, returns the `Task`; nothing is played then.

    Args:
        name: one of the Jitterbug's tasks, or an id in Gymnasium's registry.
        arguments: of the environment, plain JSON; files that they name become absolute paths.
        max_episode_steps: the time limit [steps]; the registered one if not given.
        features: a TOML file with names, units, ranges, kinds and offsets, see
            docs/environments.md.
        missing: what becomes of readings that aren't finite, see `Task`; by default an error.
        hidden: what isn't seen of it, see `jbrep.envs.view.with_view`.
        history: states that are seen at once, see there.
        domain: numbers and ranges from which each episode draws, such as {"delay": "0..2"}, see
            `jbrep.envs.domain.Domain`.
    """
    spec, given = find_spec(name), dict(arguments or {})
    if "max_episode_steps" in given:
        raise InputError(
            f"max_episode_steps is no argument of {spec.id}: --episode-steps sets the time limit"
        )
    files = files_of({**spec.kwargs, **given})
    registered = spec.max_episode_steps, spec.reward_threshold, repr(spec.kwargs)
    key = (spec.entry_point, registered, tuple(files.items()))
    text = json.dumps(absolute(given), sort_keys=True)
    task, signals = _describe(name, text, max_episode_steps, key)
    written = files_of({**spec.kwargs, **given})  # by the environment itself, such as a log
    kept = {file: digest for file, digest in files.items() if written.get(file) == digest}
    task = task.replace(arguments=absolute(dict(task.arguments)))
    if made_from := kept | code_of(spec):
        task = task.replace(made_from=made_from)
    task = with_features(task, features) if features else task
    for problem in precision_problems(task, signals):
        warnings.warn(problem, Notice, stacklevel=2)
    task = task.replace(missing=missing) if missing else task
    return with_domain(with_view(task, hidden, history), domain or {})


def as_task(given: Task | str) -> Task:
    """A task, or the one of that name, described."""
    if isinstance(given, Task):
        return given
    if not isinstance(given, str):
        raise InputError(f"the task is {given!r}: it must be a name or a Task")
    return describe(given)


@lru_cache(maxsize=64)
def _describe(
    name: str, arguments: str, max_episode_steps: int | None, key: tuple[Any, ...]
) -> tuple[Task, Signals | None]:
    """The task, and what its features went through where it was played.

    Arguments are in JSON here, and the key is which environment has that name now.
    """
    spec, given = find_spec(name), json.loads(arguments)
    if max_episode_steps is not None:
        converted(max_episode_steps, EpisodeSteps, "the number of steps in an episode")
    with refusing(f"{spec.id} failed when it was tried", told=reason), aside():
        if own := getattr(creator(spec), "describe", None):
            described = own({**spec.kwargs, **given}, max_episode_steps)
            if not (isinstance(described, Task) and described.id == spec.id):
                raise TypeError(f"describe must return a jbrep.envs.Task with the id {spec.id}")
            return described, None
        return _probe(spec.id, given, max_episode_steps)


def _probe(
    env_id: str, arguments: Mapping[str, Any], max_episode_steps: int | None
) -> tuple[Task, Signals]:
    env = instances.take(env_id, arguments, max_episode_steps)
    try:
        described = _described(env, env_id, arguments, max_episode_steps)
    except BaseException:
        instances.discard(env)
        raise
    instances.give_back(env)
    return described


def _described(
    env: gymnasium.Env[Any, Any],
    env_id: str,
    arguments: Mapping[str, Any],
    max_episode_steps: int | None,
) -> tuple[Task, Signals]:
    """What an instance shows; it is reproducible if a later episode equals its first one."""
    action = _checked_action(env_id, env.action_space)
    features = list(features_of(env_id, env.observation_space))
    spec = find_spec(env_id)
    episodes = [_play(env, seed) for seed in (0, 1, 0)]
    limit = max_episode_steps or spec.max_episode_steps
    limit = limit or _find_limit(env, env_id, (each.length for each in episodes))
    timestep = number_of(getattr(env.unwrapped, "dt", None))
    task = Task(
        id=env_id,
        name=env_id,
        features=with_kinds(env, features),
        action_low=tuple(_bounds(action)[0].tolist()),
        action_high=tuple(_bounds(action)[1].tolist()),
        max_episode_steps=limit,
        arguments=dict(arguments),
        timestep=timestep if timestep and timestep > 0 else None,
        solved_return=spec.reward_threshold,
        terminates=True if any(each.terminated for each in episodes) else None,
        reproducible=episodes[0].content == episodes[2].content,
        seed_bits=_seed_bits(env),
    )
    return task, Signals.of([each.observations for each in episodes])


def _checked_action(env_id: str, space: spaces.Space[Any]) -> spaces.Box:
    if type(space).__module__.startswith("gym."):
        raise InputError(
            f"{env_id} has spaces of old Gym, {space}: make them with gymnasium.spaces"
        )
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise InputError(
            f"{env_id} has actions in {space}: only continuous ones are possible, a Box of floats"
        )
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise InputError(
            f"{env_id} has actions without bounds, {space}: give its action space finite "
            f"ones, as in spaces.Box(-1, 1, {space.shape})"
        )
    return space


def _bounds(space: spaces.Box) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Those that actions of 32 bits can keep, flat; equal ones, of what can't move, stay equal."""
    low, high = np.ravel(space.low), np.ravel(space.high)
    below = _below(high)
    return np.where(low == high, below, -_below(-low)), below


def _below(bound: NDArray[Any]) -> NDArray[np.float64]:
    """The largest numbers up to the bounds that 32 bits can hold, as actions have them, flat."""
    single = bound.astype(np.float32)
    return np.where(single > bound, np.nextafter(single, np.float32(-np.inf)), single).astype(
        np.float64
    )


def features_of(env_id: str, space: spaces.Space[Any]) -> Iterator[Feature]:
    """The features of a flat observation, named by the keys of dictionaries, else numbered."""
    if space.is_np_flattenable and (size := spaces.utils.flatdim(space)) > MAX_FEATURES:
        raise InputError(
            f"{env_id} has observations of {size:,} numbers, flat: at most {MAX_FEATURES:,} are "
            "possible"
        )
    flat = flatten_space(space) if space.is_np_flattenable else None
    if not isinstance(flat, spaces.Box):
        raise InputError(f"{env_id} has observations in {space}, which don't make one flat array")
    parts = [*_parts("", space)]
    if any(_is_image(part) for _, part in parts):
        raise InputError(
            f"{env_id} has images as observations, {space}: only features are possible"
        )
    sizes = [spaces.utils.flatdim(part) for _, part in parts]
    numbers = [
        (group, group if size == 1 and group != "obs" else f"{group}_{i}")
        for group, size in zip(words(name for name, _ in parts), sizes, strict=True)
        for i in range(size)
    ]
    names = words(name for _, name in numbers)
    for (group, _), name, *ends in zip(numbers, names, flat.low, flat.high, strict=True):
        low, high = map(float, ends)
        bounded = math.isfinite(low) and math.isfinite(high) and max(-low, high) < 1e30
        yield Feature(
            name=name,
            low=low if bounded else None,
            high=high if bounded else None,
            group=group,
        )


def _parts(name: str, space: spaces.Space[Any]) -> Iterator[tuple[str, spaces.Space[Any]]]:
    """The spaces that dictionaries and tuples consist of, in the order of flattening."""
    if isinstance(space, spaces.Dict):
        items = list(space.spaces.items())
    elif isinstance(space, spaces.Tuple):
        items = [(f"part{i}", part) for i, part in enumerate(space.spaces)]
    else:
        yield name or "obs", space
        return
    for key, part in items:
        yield from _parts(f"{name}.{key}" if name else str(key), part)


def _is_image(space: spaces.Space[Any]) -> bool:
    return (
        isinstance(space, spaces.Box)
        and len(space.shape) >= 2
        and (space.dtype == np.uint8 or (len(space.shape) == 3 and min(space.shape[:2]) >= 16))
    )


def _find_limit(env: gymnasium.Env[Any, Any], env_id: str, lengths: Iterable["_Length"]) -> int:
    """The time limit that an environment keeps by itself, as several episodes show it.

    Args:
        env: is played.
        env_id: for messages.
        lengths: of the episodes with the seeds 0 and 1, as far as they were played.
    """
    known = [*lengths]
    for seed in range(2, 8):  # others than those of the lengths
        share = seed % 2  # of random action: one that stands still may last longer
        known.append(_length(env, env_id, seed, share))
        limit = min((each.steps for each in known if each.truncated), default=None)
        longest = max(each.steps for each in known)
        if limit and longest > limit:
            raise InputError(
                f"{env_id} has no time limit: it truncated an episode after {limit:,} steps, and "
                f"another lasted at least {longest:,}: give one with --episode-steps"
            )
        if limit and share:
            return limit
    raise InputError(f"{env_id} has no time limit: give one with --episode-steps")


class _Length(NamedTuple):
    """How long an episode was played."""

    steps: int
    truncated: bool  # after them


def _length(env: gymnasium.Env[Any, Any], env_id: str, seed: int, share: float) -> _Length:
    """How long an episode is, played for at most `_LONGEST_PROBE` steps.

    Args:
        env: is played.
        env_id: for messages.
        seed: of the episode.
        share: of random actions; the rest is the middle between the bounds.
    """
    space: Any = env.action_space
    random, middle = np.random.default_rng(seed), (space.low + space.high) / 2
    env.reset(seed=seed)
    for step in range(1, _LONGEST_PROBE + 1):
        action = middle + share * (random.uniform(space.low, space.high) - middle)
        try:
            _, _, terminated, truncated, _ = env.step(action_in(space, action))
        except Exception as error:
            if step <= _PROBE_STEPS:
                raise  # it fails whatever the limit
            raise InputError(
                f"{env_id} has no time limit within {step - 1:,} steps, where it failed: "
                f"{reason(error)}: give one with --episode-steps"
            ) from error
        if terminated or truncated:
            break
    return _Length(step, bool(truncated))


def _seed_bits(env: gymnasium.Env[Any, Any]) -> SeedBits:
    """The size of the seeds that an environment takes."""
    try:
        env.reset(seed=(1 << WIDE_SEEDS) - 1)
    except Exception:
        return NARROW_SEEDS
    return WIDE_SEEDS


class _Played(NamedTuple):
    """The first steps of an episode under random actions."""

    content: list[bytes]  # of each state, every bit
    observations: NDArray[np.float64]  # (n, d)
    terminated: bool  # by a state
    length: _Length


def _play(env: gymnasium.Env[Any, Any], seed: int) -> _Played:
    steps = [*random_play(env, seed, _PROBE_STEPS)]
    content = [flat.tobytes() + np.array(told).tobytes() for flat, *told in steps]
    observations = np.array([each.observation for each in steps], np.float64)
    *_, terminated, truncated = steps[-1]
    return _Played(content, observations, terminated, _Length(len(steps) - 1, truncated))


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


def with_features(task: Task, path: Path) -> Task:
    """The task with what a TOML file says of its features and rewards."""
    given = read_toml(path)
    try:
        changes = from_plain(given, _TaskChanges)
        rows = changes.features
        if rows is not None and len(rows) != task.size:
            raise InputError(f"it must have a [[features]] for each of the {task.size} features")
        features, offsets = list(task.features), {}
        for i, row in enumerate(rows or ()):
            said = _said(row)
            offset = said.pop("offset", 0.0)
            ends = {name: getattr(features[i], name) for name in ("low", "high")}
            left = {name: end - offset for name, end in ends.items() if end is not None}
            features[i] = features[i].replace(**left | said)
            if offset:
                offsets[features[i].name] = offset
        told = {**_said(changes), "features": features}
        return task.replace(**told, **({"offsets": offsets} if offsets else {}))
    except InputError as error:
        raise InputError(f"{path} can't be used for {task.name}: {error}") from None


def _said(changes: Record) -> dict[str, Any]:
    """The fields that a record has."""
    return {name: value for name, value in asdict(changes).items() if value is not None}
