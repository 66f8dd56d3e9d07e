"""The Jitterbug's tasks as environments for Gymnasium and for stable-baselines3.

Each class is imported on first use, so that Gymnasium's need no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.envs.gym import JitterbugEnv, JitterbugVectorEnv
    from jbrep.envs.sb3 import JitterbugVecEnv
    from jbrep.jitterbug.tasks import environment_id

__all__ = ["JitterbugEnv", "JitterbugVecEnv", "JitterbugVectorEnv", "environment_id"]

_MODULES = {
    "JitterbugEnv": "gym",
    "JitterbugVectorEnv": "gym",
    "JitterbugVecEnv": "sb3",
    "environment_id": "registration",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
