"""The settings that determine a data set."""

import math
import operator
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jbrep.dataset.schema import MAX_ROOT_SEED, check_names, episode_seed, step_specs
from jbrep.envs.task import Task
from jbrep.errors import InputError

IMPORTED = "imported"  # the kind of policy of data that were made elsewhere
_MAX_STEPS = 10**12
_MAX_SHARD_EPISODES = 1_000_000
_MAX_LETTERS = 200  # of a text in a policy's constants
_MAX_CONSTANTS = 1000  # of a policy, at each depth
_MAX_DEPTH = 6  # of lists and tables in them
_LIMITS = {  # least, most, and what it is
    "steps": (1, _MAX_STEPS, "the number of steps"),
    "seed": (0, MAX_ROOT_SEED, "the seed"),
    "shard_episodes": (1, _MAX_SHARD_EPISODES, "the number of episodes in a shard"),
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What determines the data, and how they are divided into shards.

    Raises:
        InputError: an unknown task, or one whose arrays have the names of other columns; a number
            out of range, or a value of the wrong type.
    """

    task: Task  # or the name of one, which is described then
    policy: Mapping[str, Any] = field(default_factory=lambda: {"kind": "uniform"})  # and constants
    steps: int  # the data set has the fewest whole episodes with as many
    seed: int = 0  # the root of all episodes' seeds
    shard_episodes: int = 100
    store_state: bool = False

    def __post_init__(self) -> None:
        given: Any = self.task
        if not isinstance(given, Task):
            from jbrep.envs.description import as_task  # imports Gymnasium

            object.__setattr__(self, "task", as_task(given))
        for name in _LIMITS:
            object.__setattr__(self, name, _checked_number(name, getattr(self, name)))
        check_names(self.task)
        episode_seed(self.task, self.seed, 0)  # may be too large
        if not isinstance(self.store_state, bool):
            raise InputError(f"store_state is {self.store_state!r}: it must be true or false")
        if self.store_state and not self.task.state:
            raise InputError(f"{self.task.name} has no states to store: its observations are all")
        if not _is_policy(self.policy):
            raise InputError(
                f"the policy is {str(self.policy)[:_MAX_LETTERS]!r}: it must be a kind and its "
                "constants, such as {'kind': 'constant', 'drive': 0.5}"
            )

    def as_json(self) -> dict[str, Any]:
        """The settings as plain JSON."""
        return {
            "task": self.task.name,
            "environment": self.task.as_json(),
            "policy": dict(self.policy),
            "steps": self.steps,
            "seed": self.seed,
            "shard_episodes": self.shard_episodes,
            "store_state": self.store_state,
        }

    @property
    def is_imported(self) -> bool:
        """Whether the data were made elsewhere: no episode can be simulated again."""
        return self.policy["kind"] == IMPORTED

    def row_bytes(self) -> int:
        """Bytes for each step."""
        specs = step_specs(self.task, self.store_state).values()
        return sum(spec.dtype.itemsize * math.prod(spec.row) for spec in specs)


def _checked_number(name: str, value: Any) -> int:
    """A plain Python int (JSON doesn't take NumPy's) within the limits."""
    least, most, what = _LIMITS[name]
    try:
        number = operator.index(value)
    except TypeError:
        raise InputError(f"{what} is {value!r}: it must be a whole number") from None
    if not least <= number <= most:
        raise InputError(f"{what} is {number}: it must be from {least} to {most:,}")
    return number


def _is_policy(policy: Any) -> bool:
    """A kind, which is a word, and constants."""
    if not isinstance(policy, Mapping) or not isinstance(policy.get("kind"), str):
        return False
    return re.fullmatch("[a-z-]+", policy["kind"]) is not None and _is_plain(policy)


def _is_plain(value: Any) -> bool:
    """Numbers and short text in lists and tables, few enough and not nested deeply."""
    level = [value]
    for _ in range(_MAX_DEPTH):
        values = [each for each in level if not _is_scalar(each)]
        if not all(isinstance(each, list | Mapping) for each in values):
            return False
        if sum(map(len, values)) > _MAX_CONSTANTS:
            return False
        level = [inner for each in values for inner in _inside(each)]
    return not level


def _inside(value: list[Any] | Mapping[Any, Any]) -> list[Any]:
    """The items of a list; the names, which must be text, and values of a table."""
    if isinstance(value, list):
        return value
    names = [name if isinstance(name, str) else None for name in value]
    return [*names, *value.values()]


def _is_scalar(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= _MAX_LETTERS and value.isprintable()
    return isinstance(value, int | float) and type(value) is not bool and abs(value) < _MAX_STEPS
