"""The Jitterbug: a toy robot with one motor, and its five tasks.

`load(task, seed=...)` gives a dm_control environment, `register_with_suite()` adds the tasks to
dm_control's suite; `tasks`, `simulation` and `heuristics` are the parts below them.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.jitterbug.domain import load, register_with_suite

__all__ = ["load", "register_with_suite"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jbrep.jitterbug import domain  # importing the suite takes a second

    return getattr(domain, name)
