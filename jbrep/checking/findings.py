"""What a check finds."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

Kind = Literal[
    *("reward", "sparse", "delay", "hidden", "wraps", "signs", "degrees", "world"),
    *("saturated", "scales", "copy", "constant", "random"),
]
WORST_FIRST: Mapping[Kind, str] = MappingProxyType(
    {
        "reward": "the reward hardly depends on the state",
        "sparse": "rewards are sparse",
        "delay": "actions act late",
        "hidden": "one observation isn't enough",
        "wraps": "wraps",
        "signs": "a quaternion changes its sign",
        "degrees": "in degrees",
        "world": "where the robot is in the world doesn't matter",
        "saturated": "saturated",
        "scales": "scales far apart",
        "copy": "copies",
        "constant": "constant",
        "random": "not reproducible",
    }
)


class Finding(NamedTuple):
    """Something to change."""

    kind: Kind
    features: tuple[str, ...]  # that it is about; none of all
    evidence: str
    fix: str
    numbers: Mapping[str, Any] = MappingProxyType({})  # that the evidence tells

    @property
    def title(self) -> str:
        """What it is, in a few words."""
        return WORST_FIRST[self.kind]


def several(names: tuple[str, ...], most: int = 4) -> str:
    """Names on one line, the first of many."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
