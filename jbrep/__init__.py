"""jbrep: reduced-order representations of an underactuated robot, and what they do to learning.

Importing it registers the Jitterbug's environments with Gymnasium; nothing heavy is loaded until
it is used.
"""

from types import ModuleType
from typing import TYPE_CHECKING

import wrapt

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.encoders.encoder import Encoder
    from jbrep.encoders.vec_env import JitterbugVecEnv
    from jbrep.encoders.wrapper import Encoded
    from jbrep.envs.description import describe
    from jbrep.envs.lanes import Lanes
    from jbrep.envs.task import Feature, Task

__all__ = ["Encoded", "Encoder", "Feature", "JitterbugVecEnv", "Lanes", "Task", "describe"]

__getattr__ = exports(
    __name__,
    {
        "Encoded": "encoders.wrapper",
        "Encoder": "encoders.encoder",
        "Feature": "envs.task",
        "JitterbugVecEnv": "encoders.vec_env",
        "Lanes": "envs.lanes",
        "Task": "envs.task",
        "describe": "envs.description",
    },
)


def _register(_gymnasium: ModuleType) -> None:
    from jbrep.jitterbug.tasks import register

    register()


wrapt.register_post_import_hook(_register, "gymnasium")
