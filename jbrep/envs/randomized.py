"""Tasks with a domain: what of an environment can be drawn, and what its features spread."""

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from jbrep.envs import instances
from jbrep.envs.domain import PHYSICS, SIGNALS, Domain, read_ranges
from jbrep.envs.lanes import Lanes
from jbrep.envs.make import creator, is_batched
from jbrep.envs.mujoco import physics_of
from jbrep.envs.names import spec_of
from jbrep.envs.task import Task
from jbrep.envs.varied import can_be_pushed
from jbrep.errors import InputError
from jbrep.records.record import from_plain, to_plain

_EPISODES = 5  # of random actions, in which features spread


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
    env = instances.take(task.id, task.arguments, task.max_episode_steps)
    physics = physics_of(env)
    can_push = physics and can_be_pushed(physics.model)
    own = [name for name in PHYSICS if name != "push" or can_push] if physics else []
    instances.give_back(env)
    return (*SIGNALS, *own)


def spread(task: Task) -> tuple[float, ...]:
    """The standard deviation of each feature in episodes of random actions, (D,)."""
    return _spread(json.dumps(to_plain(task.whole.undisturbed), sort_keys=True))


@lru_cache(maxsize=8)
def _spread(plain: str) -> tuple[float, ...]:
    """That of a task in JSON."""
    task = from_plain(json.loads(plain), Task)
    several = _EPISODES if is_batched(task) else 1
    low, high = task.action_low, task.action_high
    seen = []
    with Lanes(task, several) as lanes:
        for first in range(0, _EPISODES, several):
            seeds = range(first, first + several)
            randoms = [np.random.default_rng(seed) for seed in seeds]
            seen.append(lanes.reset(range(several), seeds))
            while lanes.num_active:
                active = lanes.active
                step = lanes.step([random.uniform(low, high) for random in randoms])
                seen.append(step.observation[active])
    return tuple(np.concatenate(seen).std(axis=0).tolist())
