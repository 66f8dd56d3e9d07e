"""Tasks as environments: what they are, many of them in lanes, and for stable-baselines3.

Each name is imported on first use, so that what needs no torch doesn't load it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.encoders.wrapper import Encoded
    from jbrep.envs.description import describe
    from jbrep.envs.lanes import Lanes
    from jbrep.envs.sb3 import JitterbugVecEnv, TaskVecEnv
    from jbrep.envs.task import Feature, Task
    from jbrep.jitterbug.gym import JitterbugEnv, JitterbugVectorEnv
    from jbrep.jitterbug.tasks import environment_id

__all__ = [
    "Encoded",
    "Feature",
    "JitterbugEnv",
    "JitterbugVecEnv",
    "JitterbugVectorEnv",
    "Lanes",
    "Task",
    "TaskVecEnv",
    "describe",
    "environment_id",
]

_MODULES = {
    "Encoded": "jbrep.encoders.wrapper",
    "Feature": "jbrep.envs.task",
    "JitterbugEnv": "jbrep.jitterbug.gym",
    "JitterbugVecEnv": "jbrep.envs.sb3",
    "JitterbugVectorEnv": "jbrep.jitterbug.gym",
    "Lanes": "jbrep.envs.lanes",
    "Task": "jbrep.envs.task",
    "TaskVecEnv": "jbrep.envs.sb3",
    "describe": "jbrep.envs.description",
    "environment_id": "jbrep.jitterbug.tasks",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
