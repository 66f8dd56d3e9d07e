"""The settings that determine a data set."""

import math
import operator
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jbrep.dataset.schema import MAX_ROOT_SEED, Spec, all_specs, step_specs
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import EPISODE_STEPS, Task, get_task

_MAX_STEPS = 10**12  # episode numbers have 32 bits
_MAX_SHARDS = 10_000
_MAX_SHARD_EPISODES = 10_000
_LIMITS = {  # least, most, and what it is
    "steps": (1, _MAX_STEPS, "the number of steps"),
    "seed": (0, MAX_ROOT_SEED, "the seed"),
    "shard_episodes": (1, _MAX_SHARD_EPISODES, "the number of episodes in a shard"),
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What determines the data, and how they are divided into shards.

    Raises:
        InputError: an unknown task, a number out of range, or a value of the wrong type.
    """

    task: str
    policy: Mapping[str, Any] = field(default_factory=lambda: {"kind": "uniform"})  # and constants
    steps: int  # rounded up to whole episodes
    seed: int = 0  # the root of all episodes' seeds
    shard_episodes: int = 100
    store_state: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.task, str):
            raise InputError(f"the task is {self.task!r}: it must be a name")
        get_task(self.task)
        for name in _LIMITS:
            object.__setattr__(self, name, _checked_number(name, getattr(self, name)))
        if self.num_shards > _MAX_SHARDS:
            raise InputError(
                f"{self.num_shards:,} shards are more than {_MAX_SHARDS:,}: put more than "
                f"{self.shard_episodes} episodes in a shard"
            )
        if not isinstance(self.store_state, bool):
            raise InputError(f"store_state is {self.store_state!r}: it must be true or false")
        if not _is_policy(self.policy):
            raise InputError(
                f"the policy is {self.policy!r}: it must be a kind and its constants, such as "
                "{'kind': 'constant', 'drive': 0.5}"
            )

    @property
    def definition(self) -> Task:
        """The task of that name."""
        return get_task(self.task)

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return -(-self.steps // EPISODE_STEPS)

    @property
    def num_shards(self) -> int:
        """Number of shards."""
        return -(-self.episodes // self.shard_episodes)

    def shard_range(self, shard: int) -> range:
        """Numbers of the episodes in a shard."""
        start = shard * self.shard_episodes
        return range(start, min(start + self.shard_episodes, self.episodes))

    def specs(self) -> dict[str, Spec]:
        """The columns of each shard."""
        return all_specs(self.definition, self.store_state)

    def row_bytes(self) -> int:
        """Bytes for each control step."""
        specs = step_specs(self.definition, self.store_state).values()
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
    """A kind, which is a word, and constants, which are numbers."""
    if not isinstance(policy, Mapping) or not isinstance(policy.get("kind"), str):
        return False
    constants = (value for name, value in policy.items() if name != "kind")
    return re.fullmatch("[a-z-]+", policy["kind"]) is not None and all(
        type(value) is not bool and isinstance(value, int | float) and abs(value) < _MAX_STEPS
        for value in constants
    )
