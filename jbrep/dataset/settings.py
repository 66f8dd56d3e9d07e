"""The settings that determine a data set."""

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jbrep.dataset.policy import IMPORTED as IMPORTED
from jbrep.dataset.policy import MAX_LETTERS, MIXTURE, is_policy
from jbrep.dataset.schema import (
    FORMAT_VERSION,
    MAX_ROOT_SEED,
    MIXTURE_SPECS,
    Spec,
    all_specs,
    check_names,
    episode_seed,
    step_specs,
)
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.record import to_plain

_MAX_STEPS = 10**12
_MAX_SHARD_EPISODES = 1_000_000
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
        if not is_policy(self.policy):
            raise InputError(
                f"the policy is {str(self.policy)[:MAX_LETTERS]!r}: it must be a kind and its "
                "constants, such as {'kind': 'constant', 'drive': 0.5}"
            )

    def as_json(self) -> dict[str, Any]:
        """The settings as plain JSON."""
        return {
            "task": self.task.name,
            "environment": to_plain(self.task),
            "policy": dict(self.policy),
            "steps": self.steps,
            "seed": self.seed,
            "shard_episodes": self.shard_episodes,
            "store_state": self.store_state,
        }

    @property
    def weights(self) -> list[float]:
        """The weights of a mixture's parts; of another policy, none."""
        parts = self.policy["parts"] if self.policy["kind"] == MIXTURE else ()
        return [weight for weight, _ in parts]

    def specs(self, version: int = FORMAT_VERSION) -> dict[str, Spec]:
        """The columns of each shard, by their paths in the file."""
        mixture = MIXTURE_SPECS if self.weights else {}
        return all_specs(self.task, self.store_state, version) | mixture

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
