"""Tasks and their environments, many of them stepped in lanes; no robot and no encoder."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.envs.description import describe
    from jbrep.envs.lanes import Lanes
    from jbrep.envs.task import Feature, Task

__all__ = ["Feature", "Lanes", "Task", "describe"]

__getattr__, __dir__ = exports(
    __name__, {"Feature": "task", "Lanes": "lanes", "Task": "task", "describe": "description"}
)
