"""What a run has recorded so far."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from jbrep.envs.recording import Outcome
from jbrep.records.tables import rounded
from jbrep.rl.files import Episode, Evaluation, Info


@dataclass
class History:
    """What a run has recorded so far, over all the processes that worked on it.

    Attributes:
        episodes: of training.
        evaluations: of the deterministic policy.
        infos: what the environment told at the ends of their episodes.
        seconds_before: wall time of earlier processes [s].
        first_step: the training step from which this process continues.
        means: mean return of each evaluation; progress asks for it at every rollout.
    """

    episodes: list[Episode] = field(default_factory=list)
    evaluations: list[Evaluation] = field(default_factory=list)
    infos: list[Info] = field(default_factory=list)
    seconds_before: float = 0.0
    first_step: int = 0
    means: list[float] = field(init=False)
    _started: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.means = self._means()

    @property
    def seconds(self) -> float:
        """The wall time so far."""
        return round(self.seconds_before + time.monotonic() - self._started, 1)

    def _means(self) -> list[float]:
        by_step = groupby(self.evaluations, lambda each: each.step)
        return [float(np.mean([each.episode_return for each in own])) for _, own in by_step]

    def add(self, step: int, outcome: Outcome) -> None:
        """Record an evaluation after so many steps."""
        returns: Sequence[float] = [rounded(each) for each in outcome.returns]
        self.evaluations += [Evaluation(step, i, each) for i, each in enumerate(returns)]
        told = enumerate(outcome.numbers)
        self.infos += [Info(step, i, *each) for i, numbers in told for each in numbers.items()]
        self.means.append(float(np.mean(returns)))

    def drop_from(self, step: int) -> None:
        """Drop the evaluations after so many steps, or more."""
        self.evaluations = [row for row in self.evaluations if row.step < step]
        self.infos = [row for row in self.infos if row.step < step]
        self.means = self._means()
