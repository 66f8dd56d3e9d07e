"""The Jitterbug: a toy robot with one motor, and its five tasks.

`load(task, seed=...)` gives a dm_control environment, `register_with_suite()` adds the tasks to
dm_control's suite; `tasks`, `simulation` and `heuristics` are the parts below them.
"""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.jitterbug.domain import load as load
    from jbrep.jitterbug.domain import register_with_suite as register_with_suite
    from jbrep.jitterbug.gym import JitterbugEnv as JitterbugEnv
    from jbrep.jitterbug.gym import JitterbugVectorEnv as JitterbugVectorEnv
    from jbrep.jitterbug.tasks import environment_id as environment_id

__getattr__, __dir__, __all__ = exports(__name__)
