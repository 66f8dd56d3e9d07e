"""The Jitterbug's tasks as environments: Gymnasium's, and stable-baselines3's."""

from typing import TYPE_CHECKING, Any

import gymnasium

from jbrep.jitterbug.tasks import EPISODE_STEPS, TASKS

if TYPE_CHECKING:
    from jbrep.envs.gym import JitterbugEnv, JitterbugVectorEnv
    from jbrep.envs.sb3 import JitterbugVecEnv

__all__ = ["JitterbugEnv", "JitterbugVecEnv", "JitterbugVectorEnv", "environment_id", "register"]

SOLVED = 900  # the return at which the paper calls a task solved


def environment_id(task: str) -> str:
    """Gymnasium's id of a task: `face_direction` is `Jitterbug/FaceDirection-v0`."""
    return f"Jitterbug/{task.title().replace('_', '')}-v0"


def register() -> None:
    """Register the five tasks with Gymnasium; importing jbrep does it."""
    for task in TASKS:
        gymnasium.register(
            environment_id(task),
            entry_point="jbrep.envs.gym:JitterbugEnv",
            vector_entry_point="jbrep.envs.gym:JitterbugVectorEnv",
            max_episode_steps=EPISODE_STEPS,
            reward_threshold=SOLVED,
            kwargs={"task": task},
        )


def __getattr__(name: str) -> Any:
    if name == "JitterbugVecEnv":
        from jbrep.envs import sb3 as module  # takes torch along
    elif name in __all__:
        from jbrep.envs import gym as module  # type: ignore[no-redef]
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(module, name)
