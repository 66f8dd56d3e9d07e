"""What an environment shows when it is played: its task, as far as that can be seen."""

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten_space
from gymnasium.wrappers import TransformAction
from numpy.typing import ArrayLike, NDArray

from jbrep.envs.infos import number_of
from jbrep.envs.isolation import in_time
from jbrep.envs.make import Env, action_in, discard, flattener, give_back, number, of_size, take
from jbrep.envs.names import find_spec
from jbrep.envs.physics import physics_of, planar_root, robot_joint
from jbrep.envs.task import (
    MAX_FEATURES,
    NARROW_SEEDS,
    SPATIAL,
    WIDE_SEEDS,
    Array,
    Feature,
    Frame,
    Kind,
    SeedBits,
    Task,
)
from jbrep.errors import InputError
from jbrep.records.record import Finite
from jbrep.text import words

Bounds = tuple[tuple[Finite, Finite], ...]  # of each number of an action, or one for all

_STEPS = 200  # of each episode that is compared
_LONGEST = 10_000  # steps in search of a time limit

_KIND_EPISODES, _KIND_STEPS = 3, 40  # to see which feature is which number of MuJoCo's state
_SAME = 1e-6  # relative difference, of observations in float32
_TURN = 2 * np.pi + 1e-3  # [rad], as models round it

_ALONE = "obs"  # what the features of an observation without names are called
_LARGE = 1000.0  # below it, 32 bits hold each number to .00006
_LEVELS = 4096  # that 32 bits should have of what a feature goes through


def probe(
    env_id: str, arguments: Mapping[str, Any], max_episode_steps: int | None, bounds: Bounds = ()
) -> "tuple[Task, Signals]":
    """The task of an environment, and what its features went through."""
    env = take(env_id, arguments, max_episode_steps)
    try:
        found = _task_of(_bounded(env, env_id, bounds), env_id, arguments, max_episode_steps)
    except BaseException:
        discard(env)
        raise
    give_back(env)
    return found


def _task_of(
    env: Env, env_id: str, arguments: Mapping[str, Any], max_episode_steps: int | None
) -> "tuple[Task, Signals]":
    action = _checked_action(env_id, env.action_space)
    features = [*features_of(env_id, env.observation_space)]
    spec = find_spec(env_id)
    episodes = [[*_play(env, seed, _STEPS)] for seed in (0, 1)]  # a fresh instance, a used one
    own = random.getstate()
    episodes.append([*map(_beside_others, _play(env, 0, _STEPS))])
    random.setstate(own)
    limit = max_episode_steps or spec.max_episode_steps
    low, high = _bounds(action)
    timestep = number_of(getattr(env.unwrapped, "dt", None))
    task = Task(
        id=env_id,
        name=env_id,
        features=_with_kinds(env, features),
        action_low=tuple(low.tolist()),
        action_high=tuple(high.tolist()),
        max_episode_steps=limit or _find_limit(env, env_id),
        arguments=dict(arguments),
        timestep=timestep if timestep and timestep > 0 else None,
        solved_return=spec.reward_threshold if limit == spec.max_episode_steps else None,
        terminates=True if any(steps[-1].terminated for steps in episodes) else None,
        reproducible=_content(episodes[0]) == _content(episodes[2]),
        seed_bits=_seed_bits(env),
    )
    return task, Signals.of(np.array([each.observation for steps in episodes for each in steps]))


class _Step(NamedTuple):
    observation: NDArray[Any]  # flat, (d,)
    reward: float
    terminated: bool
    truncated: bool


def _beside_others(step: _Step) -> _Step:
    """A step, after which other environments draw from the process's generators."""
    np.random.random()  # noqa: NPY002
    random.random()
    return step


def _play(env: Env, seed: int, most: int, still: bool = False) -> Iterator[_Step]:
    """The first state of an episode, and up to so many steps, at random or in the middle."""
    random, flat = np.random.default_rng(seed), flattener(env.observation_space)
    space: Any = env.action_space
    size, middle = flatdim(env.observation_space), (space.low + space.high) / 2
    with in_time():
        observation, info = env.reset(seed=seed)
    if not isinstance(info, Mapping):
        raise ValueError("its reset must give an observation and info, as in Gymnasium")
    yield _Step(of_size(np.array(flat(observation)), size), 0.0, False, False)
    for _ in range(most):
        action = middle if still else random.uniform(space.low, space.high)
        with in_time():
            observation, reward, terminated, truncated, _ = env.step(action_in(space, action))
        ends = bool(number(terminated, "terminated")), bool(number(truncated, "truncated"))
        yield _Step(of_size(np.array(flat(observation)), size), number(reward, "reward"), *ends)
        if any(ends):
            break


def _content(steps: Sequence[_Step]) -> list[bytes]:
    return [flat.tobytes() + np.array(others).tobytes() for flat, *others in steps]


def _find_limit(env: Env, env_id: str) -> int:
    """The time limit that an environment keeps by itself, as a still and a random episode show."""
    played = [[*_play(env, seed, _LONGEST, still=seed == 2)] for seed in (2, 3)]
    cut = {len(steps) - 1 for steps in played if steps[-1].truncated}
    if len(cut) != 1 or max(map(len, played)) - 1 > min(cut):
        raise InputError(f"{env_id} has no time limit: give one with `episode_steps`")
    return cut.pop()


def _seed_bits(env: Env) -> SeedBits:
    try:
        env.reset(seed=(1 << WIDE_SEEDS) - 1)
    except Exception:
        env.reset(seed=1 << NARROW_SEEDS)  # as the first of those by which policies are evaluated
        return NARROW_SEEDS
    return WIDE_SEEDS


# spaces


def _bounded(env: Env, env_id: str, bounds: Bounds) -> Env:
    """The environment with bounds of its actions, if any are given: it takes all within as is."""
    space = env.action_space
    if not (bounds and isinstance(space, spaces.Box)):
        return env
    low, high = within(env_id, np.ravel(space.low), np.ravel(space.high), bounds)
    ends: Any = (action_in(space, each) for each in (low, high))
    return TransformAction(env, lambda action: action, spaces.Box(*ends, dtype=space.dtype))


def within(env_id: str, low: ArrayLike, high: ArrayLike, bounds: Bounds) -> tuple[Array, Array]:
    """Bounds of k numbers of an action, one for each or one for all, within those that it has."""
    own = np.array([low, high], np.float64)
    if len(bounds) not in (1, own.shape[1]):
        raise InputError(
            f"`action_bounds` are {len(bounds)}: {env_id} has actions of {own.shape[1]} numbers"
        )
    ends = np.broadcast_to(np.array(bounds, np.float64).T, own.shape)
    if (ends[0] < own[0]).any() or (ends[1] > own[1]).any() or (ends[0] > ends[1]).any():
        has = ", ".join(dict.fromkeys(f"{a:g}..{b:g}" for a, b in own.T))
        raise InputError(f"`action_bounds` of {env_id} must be in order and within its own, {has}")
    return ends[0].copy(), ends[1].copy()


def _checked_action(env_id: str, space: spaces.Space[Any]) -> spaces.Box:
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise InputError(
            f"{env_id} has actions in {space}: only continuous ones are possible, a Box of floats"
        )
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise InputError(
            f"{env_id} has actions without bounds, {space}: give `action_bounds`, such as -1..1"
        )
    return space


def _bounds(space: spaces.Box) -> tuple[Array, Array]:
    """Those that actions of 32 bits can keep, flat; equal ones, of what can't move, stay equal."""
    low, high = np.ravel(space.low), np.ravel(space.high)
    below = _below(high)
    return np.where(low == high, below, -_below(-low)), below


def _below(bound: NDArray[Any]) -> Array:
    single = bound.astype(np.float32)
    lower = np.nextafter(single, np.float32(-np.inf))
    return np.where(single > bound, lower, single).astype(np.float64)


def features_of(env_id: str, space: spaces.Space[Any]) -> Iterator[Feature]:
    """The features of a flat observation, named by the keys of dictionaries, else numbered."""
    flat = flatten_space(space) if space.is_np_flattenable else None
    if not isinstance(flat, spaces.Box):
        raise InputError(f"{env_id} has observations in {space}, which don't make one flat array")
    parts = [*_parts("", space)]
    if any(_is_image(part) for _, part in parts) or flat.shape[0] > MAX_FEATURES:
        raise InputError(
            f"{env_id} has observations in {space}: only features are possible, no images, and at "
            f"most {MAX_FEATURES:,}"
        )
    sizes = [flatdim(part) for _, part in parts]
    numbers = [
        (group, group if size == 1 and group != _ALONE else f"{group}_{i}")
        for group, size in zip(words(name for name, _ in parts), sizes, strict=True)
        for i in range(size)
    ]
    names = words(name for _, name in numbers)
    for (group, _), name, *ends in zip(numbers, names, flat.low, flat.high, strict=True):
        low, high = map(float, ends)
        bounded = math.isfinite(low) and math.isfinite(high) and max(-low, high) < 1e30
        usual = (low, high) if bounded else (None, None)
        yield Feature(name=name, low=usual[0], high=usual[1], group=group)


def _parts(name: str, space: spaces.Space[Any]) -> Iterator[tuple[str, spaces.Space[Any]]]:
    if isinstance(space, spaces.Dict):
        items = [*space.spaces.items()]
    elif isinstance(space, spaces.Tuple):
        items = [(f"part{i}", part) for i, part in enumerate(space.spaces)]
    else:
        yield name or _ALONE, space
        return
    for key, part in items:
        yield from _parts(f"{name}.{key}" if name else str(key), part)


def _is_image(space: spaces.Space[Any]) -> bool:
    return (
        isinstance(space, spaces.Box)
        and len(space.shape) >= 2
        and (space.dtype == np.uint8 or (len(space.shape) == 3 and min(space.shape[:2]) >= 16))
    )


# kinds of features, by MuJoCo's model: a feature is what it equals in all states of some episodes


_TURN_PARTS = "_qw _qx _qy _qz"
_PARTS = {  # of the positions and velocities of joints, where these have several
    int(mujoco.mjtJoint.mjJNT_BALL): (_TURN_PARTS, "_velocity_x _velocity_y _velocity_z"),
    int(mujoco.mjtJoint.mjJNT_FREE): (
        f"_x _y _z {_TURN_PARTS}",
        "_velocity_x _velocity_y _velocity_z _angular_velocity_x _angular_velocity_y "
        "_angular_velocity_z",
    ),
}


class _Quantity(NamedTuple):
    """A number of MuJoCo's state, and what it is."""

    kind: Kind
    frame: Frame
    unit: str
    whole: str = ""  # the vector, point or quaternion that it belongs to; empty if none
    axis: int = 0  # its place in that


def _with_kinds(env: Env, features: Sequence[Feature]) -> tuple[Feature, ...]:
    """The features with the kinds that follow from the model; those that don't stay scalars."""
    physics = physics_of(env)
    if physics is None:
        return tuple(features)
    quantities, names = dict(_quantities(physics.model)), _state_names(physics.model)
    observations, states = [], []
    for episode in range(_KIND_EPISODES):
        for step in islice(_play(env, episode, _KIND_STEPS), 1, None):
            observations.append(step.observation)
            data = physics_of(env).data  # type: ignore[union-attr] # it may be another after a reset
            states.append(np.concatenate((data.qpos, data.qvel)))
    columns = np.array(observations, np.float64).T
    places = [_match(column, np.array(states)) for column in columns]
    named = words(  # but what a dictionary's keys name
        names[place] if place is not None and each.group == _ALONE else each.name
        for place, each in zip(places, features, strict=True)
    )
    features = [each.replace(name=name) for each, name in zip(features, named, strict=True)]
    found = [None if place is None else quantities.get(place) for place in places]
    return tuple(_as_found(features, found))


def _state_names(model: mujoco.MjModel) -> list[str]:
    """Names of the numbers of the state, qpos and then qvel, after their joints."""
    joints = [model.joint(i) for i in range(model.njnt)]
    return [
        f"{joint.name or f'joint{joint.id}'}{part}"
        for which in (0, 1)
        for joint in joints
        for part in _PARTS.get(joint.type.item(), ("", "_velocity"))[which].split(" ")
    ]


def _quantities(model: mujoco.MjModel) -> Iterator[tuple[int, _Quantity]]:
    """Numbers of the state, qpos and then qvel, that aren't scalars, by their places."""
    robot = robot_joint(model)
    places, speeds = model.jnt_qposadr.tolist(), (model.nq + model.jnt_dofadr).tolist()
    for joint, (place, speed) in enumerate(zip(places, speeds, strict=True)):
        if joint == robot:
            name = f"joint{joint}."
            yield from _row(place, "point", "world", "m", f"{name}position", 3)
            yield from _row(place + 3, "quaternion", "", "1", f"{name}attitude", 4)
            yield from _row(speed, "vector", "world", "m/s", f"{name}velocity", 3)
            yield from _row(speed + 3, "vector", "body", "rad/s", f"{name}angular_velocity", 3)
        elif _is_angle(model, joint):
            yield place, _Quantity("angle", "", "rad")
    if robot is None and (root := planar_root(model)):
        for axis, joint in enumerate(root[:2]):
            yield places[joint], _Quantity("point", "world", "m", "root.position", axis)
            yield speeds[joint], _Quantity("vector", "world", "m/s", "root.velocity", axis)
        yield places[root[2]], _Quantity("angle", "world", "rad")


def _row(
    place: int, kind: Kind, frame: Frame, unit: str, whole: str, count: int
) -> Iterator[tuple[int, _Quantity]]:
    for axis in range(count):
        yield place + axis, _Quantity(kind, frame, unit, whole, axis)


def _is_angle(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is a hinge on which a turn more is the same place."""
    several = model.jnt_limited[joint] and np.ptp(model.jnt_range[joint]) > _TURN
    return model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and not several


def _match(column: Array, states: Array) -> int | None:
    """Which number of the state a feature is, if it equals one and no other."""
    scale = np.abs(column).max()
    if np.ptp(column) <= _SAME * scale:
        return None  # a constant could be anything
    off = np.abs(states - column[:, None]).max(axis=0)
    equal = np.flatnonzero(off <= _SAME * scale)
    return int(equal[0]) if len(equal) == 1 else None


def _as_found(features: Sequence[Feature], found: Sequence[_Quantity | None]) -> Iterator[Feature]:
    """Features as what they were found to be, each whole vector a group of its own."""
    parts: dict[str, int] = {}  # of each group, by its name
    before, i = None, 0
    while i < len(features):
        count, quantity = _whole(found[i:]), found[i]
        key = features[i].group
        if quantity and count > 1:
            key = f"{key}.{quantity.whole}"
        if key != before:
            parts[key] = parts.get(key, 0) + 1
        group = key if parts[key] == 1 else f"{key}.{parts[key]}"
        for each in features[i : i + count]:
            if quantity is None or (quantity.whole and count == 1):
                yield each.replace(group=group)
            else:
                yield each.replace(
                    group=group,
                    kind=quantity.kind,
                    frame=quantity.frame,
                    unit=each.unit or quantity.unit,
                    bounded=each.bounded and quantity.kind != "angle",
                )
        before, i = key, i + count


def _whole(found: Sequence[_Quantity | None]) -> int:
    """How many features from the first one on are one vector, point or quaternion; 1 if none."""
    first = found[0]
    if first is None or not first.whole or first.axis:
        return 1
    row = [
        each is not None and each.whole == first.whole and each.axis == axis
        for axis, each in enumerate(found[:4])
    ]
    count = row.index(False) if False in row else len(row)
    return count if count in SPATIAL[first.kind] else 1


# whether 32 bits hold what a feature tells: a clock's seconds since 1970 are one number there


class Signals(NamedTuple):
    """Least and greatest values of a task's features, (d,) each."""

    low: Array
    high: Array

    @classmethod
    def of(cls, observations: NDArray[Any]) -> "Signals":
        """Those of the finite ones of some observations, (n, d)."""
        finite = observations[np.isfinite(observations).all(axis=1)].astype(np.float64)
        return cls(finite.min(axis=0, initial=np.inf), finite.max(axis=0, initial=-np.inf))

    def joined(self, other: "Signals") -> "Signals":
        """Those of these and of others."""
        return Signals(np.minimum(self.low, other.low), np.maximum(self.high, other.high))


def precision_problems(task: Task, signals: Signals | None) -> Iterator[str]:
    """A line for each feature of which 32 bits lose what changes, with an offset that helps."""
    if signals is None:
        return
    for name, offset, low, high in zip(task.feature_names, task.offset, *signals, strict=True):
        largest = max(abs(low - offset), abs(high - offset))
        spacing = float(np.spacing(np.float32(largest)))
        if _LARGE < largest < np.inf and 0 < high - low < _LEVELS * spacing:
            yield (
                f"{task.name}: {name} is from {low:.10g} to {high:.10g}, but numbers of 32 bits "
                f"are {spacing:.3g} apart there: give it an offset in `features`, such as offset = "
                f"{np.floor(low):.10g}"
            )
