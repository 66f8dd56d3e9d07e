"""Whether a task is the same wherever its robot stands and however it is turned: tried out."""

import warnings
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces.utils import flatten

from jbrep.coordinates.coordinates import Coordinates
from jbrep.coordinates.made import Ingredient, System, make_coordinates
from jbrep.envs.isolation import isolated
from jbrep.envs.make import action_in, make_env
from jbrep.envs.names import INSTANCE, spec_of
from jbrep.envs.physics import quarter_turn
from jbrep.envs.task import Array, Task
from jbrep.envs.view import Window
from jbrep.errors import InputError, Notice, refusing

_SEEDS, _MOST_SEEDS = 3, 100  # episodes, and at most, where all rewards were the same so far
_BEFORE, _AFTER = 10, 5  # steps before the turn and after it
_SAME = 1e-5  # relative difference of rewards and coordinates, as float32 rounds them
_SHIFT = (0.5, -0.25)  # [m]


class NotTheSameError(InputError):
    """A task isn't the same for a turned robot."""


def tried_coordinates(
    task: Task, system: System, leave_out: Collection[Ingredient] = ()
) -> Coordinates | None:
    """What `make_coordinates` makes, once symmetry was tried out."""
    made = make_coordinates(task, system, leave_out)
    if made and system == "symmetry":
        check_invariant(made)
    return made


def check_invariant(coordinates: Coordinates) -> None:
    """Make sure that turning and shifting the robot changes neither coordinates nor rewards.

    Two robots are played alike; then one of them is turned by a quarter and, if the task has points
    in the world, shifted, with the targets that the environment moves along. Their episodes must
    end alike, too. Where all rewards were the same, a notice says that they tell nothing.
    """
    task = coordinates.task
    with refusing(f"symmetry can't be tried on {task.name}"), isolated():
        steps = _tried(task)
    if not steps:
        raise InputError(
            f"symmetry can't be tried on {task.name}: its episodes under random actions end within "
            f"{_BEFORE} steps; use coordinates"
        )
    names = (*coordinates.names, "the reward")
    both = np.array([np.column_stack((coordinates.forward(o), r)) for o, r in steps])
    sizes = np.abs(both).max(axis=(0, 1))
    sizes[:-1] = np.maximum(sizes[:-1], 1)  # a reward may be in any unit
    apart = np.abs(both[:, 0] - both[:, 1]) / np.where(sizes, sizes, 1)
    wrong = np.flatnonzero(apart.max(axis=1) > _SAME)
    if len(wrong):
        worst = apart[wrong[0]].argmax()
        raise _not_the_same(task, names[worst], *both[wrong[0], :, worst])
    if not np.ptp(both[..., -1]):
        warnings.warn(
            f"{task.name} gave the reward {both[0, 0, -1]:.4g} at every step at which symmetry was "
            "tried: if its rewards depend on where the robot is in the world, use coordinates",
            Notice,
            stacklevel=2,
        )


def _not_the_same(task: Task, what: str, as_it_is: float, turned: float) -> NotTheSameError:
    past = "; what is seen of the past isn't turned" if task.view and task.view.history > 1 else ""
    return NotTheSameError(
        f"{task.name} isn't the same for a turned robot: {what} is {as_it_is:.4g} without a "
        f"quarter turn and {turned:.4g} after one{past}; use coordinates in place of symmetry"
    )


def _tried(task: Task) -> list[tuple[Array, Array]]:
    if task.id.startswith(INSTANCE):
        raise InputError(
            f"symmetry can't be tried on {task.name}, of which there is one: give its class"
        )
    envs: list[gymnasium.Env[Any, Any]] = []
    try:
        for _ in range(2):
            envs.append(make_env(spec_of(task).id, task.arguments, task.max_episode_steps))
        steps = list[tuple[Array, Array]]()
        for seed in range(_MOST_SEEDS):
            steps += _played(envs, task, seed)
            if seed + 1 >= _SEEDS and steps and np.ptp([reward for _, reward in steps]):
                break
        return steps
    finally:
        for env in envs:
            env.close()


def _played(
    envs: Sequence[gymnasium.Env[Any, Any]], task: Task, seed: int
) -> Iterator[tuple[Array, Array]]:
    """Observations (2, d) and rewards (2,) of some steps of a robot, and of the same one turned."""
    random = np.random.default_rng(seed)
    shift = _SHIFT if any(each.kind == "point" for each in task.features) else (0.0, 0.0)
    window = Window(task, len(envs), task.view.places) if task.view else None
    turned = _BEFORE + (task.view.history if task.view else 1)  # steps until all that is seen is
    begun = [env.reset(seed=seed)[0] for env in envs]
    if window:
        window.begin(range(len(envs)), _flat(envs, begun) - task.whole.offset)
    for step in range(turned + _AFTER):
        if step == _BEFORE and not quarter_turn(envs[1], shift):
            raise InputError(
                f"symmetry can't be tried on {task.name}: it isn't the only free body in MuJoCo, "
                "and its environment has no method quarter_turn(shift); give it one, or use "
                "coordinates"
            )
        action = random.uniform(task.action_low, task.action_high).astype(np.float32)
        moved = [env.step(action_in(env.action_space, action)) for env in envs]
        ends = [bool(each[2] or each[3]) for each in moved]
        if ends[0] != ends[1]:
            raise _not_the_same(task, "the end of the episode", *ends)
        seen = _flat(envs, [each[0] for each in moved]) - task.whole.offset
        if window:
            seen = window.step(np.ones(len(envs), bool), np.stack([action] * len(envs)), seen)
        if step >= turned - 1:
            yield seen, np.array([each[1] for each in moved], np.float64)
        if any(ends):
            return


def _flat(envs: Sequence[gymnasium.Env[Any, Any]], given: Sequence[Any]) -> Array:
    pairs = zip(envs, given, strict=True)
    return np.array([flatten(env.observation_space, each) for env, each in pairs], np.float64)
