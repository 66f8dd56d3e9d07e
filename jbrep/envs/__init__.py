"""Tasks and their environments, many of them stepped at once; no robot and no encoder."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.envs.description import describe as describe
    from jbrep.envs.environments import Environments as Environments
    from jbrep.envs.task import Feature as Feature
    from jbrep.envs.task import Task as Task

__getattr__, __dir__, __all__ = exports(__name__)
