"""What is found of a claim: an estimate, what it is held against, and a verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from jbrep.stats.bootstrap import Interval
from jbrep.stats.runs import Group

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
NOT_YET, EXPLORATORY = "not yet", "exploratory"
VERDICTS = (SUPPORTED, CONTRADICTED, UNDECIDED, NOT_YET, EXPLORATORY)

Key = tuple[str, str]  # task and algorithm


@dataclass(frozen=True)
class Statement:
    """A claim in words.

    Args:
        name: in a word or two.
        statement: as a sentence.
        estimand: what is estimated.
        is_ratio: whether that is a ratio, of which logarithms are drawn.
    """

    name: str
    statement: str
    estimand: str
    is_ratio: bool = False


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is found of a claim, of one representation against the baseline.

    Args:
        claim: its name.
        verdict: one of VERDICTS.
        estimate: with its 95 % interval; without one for three runs or fewer.
        boundary: that the estimate is held against.
        p: two-sided, of lying on the boundary; NaN where there is none.
        level: of the last test, two-sided; NaN if there was none.
        interval: of 1 minus that level.
        runs: of the representation and of the baseline that count.
        encoders: how many of the representation are the units of the test; 0 if its runs are.
        look: how many looks had come when it was decided or last tested; 0 if none.
        reason: why it is not decided, if not because the estimate is too rough.

    Raises:
        ValueError: an unknown verdict, or several intervals in place of one.
    """

    claim: str
    verdict: str
    estimate: Interval
    boundary: float
    p: float
    level: float
    interval: Interval
    runs: tuple[int, int]
    encoders: int
    look: int
    reason: str | None

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"unknown verdict {self.verdict!r}")
        if np.ndim(self.estimate.value) or np.ndim(self.interval.value):
            raise ValueError("estimate and interval must be one interval each")


Verdicts = Mapping[Key, Mapping[str, tuple[Verdict, ...]]]  # then by representation


class Judge(Protocol):
    """What reaches verdicts, by rules of its own."""

    @property
    def claims(self) -> Sequence[Statement]:
        """What is claimed, in the order of the verdicts."""

    @property
    def notes(self) -> Sequence[str]:
        """How verdicts are reached, in sentences."""

    def __call__(self, groups: Mapping[Key, Group], seed: int) -> Verdicts:
        """A verdict on each claim for each representation but the first of each group.

        Args:
            groups: runs by task and algorithm, then by representation, the baseline first.
            seed: of all resampling.
        """
