"""The Jitterbug: a toy robot with one motor, and its five tasks.

`load(task, seed=...)` gives a dm_control environment, `register_with_suite()` adds the tasks to
dm_control's suite; `tasks`, `simulation` and `heuristics` are the parts below them.
"""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.jitterbug.domain import load, register_with_suite
    from jbrep.jitterbug.gym import JitterbugEnv, JitterbugVectorEnv
    from jbrep.jitterbug.tasks import environment_id

__all__ = ["JitterbugEnv", "JitterbugVectorEnv", "environment_id", "load", "register_with_suite"]

__getattr__, __dir__ = exports(
    __name__,
    {
        "JitterbugEnv": "gym",
        "JitterbugVectorEnv": "gym",
        "environment_id": "tasks",
        "load": "domain",
        "register_with_suite": "domain",
    },
)
