"""What a run has recorded so far, and what it tells while it goes on."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter

from jbrep.rl.files import Episode, Evaluation

Watch = Callable[[int, float | None], None]  # steps so far; mean return of the last evaluation

WEIGHTS_NOT_FINITE = "the policy's weights are not finite"  # reasons for a run to fail
ACTIONS_NOT_FINITE = "the policy's actions are not finite"


class DivergedError(ArithmeticError):
    """A loss or a weight of the policy is NaN or infinite: training can't continue."""


@dataclass
class History:
    """What a run has recorded so far, over all the processes that worked on it.

    Attributes:
        episodes: of training.
        evaluations: of the deterministic policy.
        first_step: the training step from which this process continues.
        earlier_seconds: the wall time that earlier processes took.
    """

    episodes: list[Episode] = field(default_factory=list)
    evaluations: list[Evaluation] = field(default_factory=list)
    first_step: int = 0
    earlier_seconds: float = 0.0
    _started: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """The wall time so far."""
        return round(self.earlier_seconds + time.monotonic() - self._started, 1)

    def evaluated(self, step: int, returns: NDArray[np.float64], logger: Logger) -> float:
        """Record an evaluation's returns (e,) after so many steps, and log their mean.

        Returns:
            The mean.
        """
        rounded = returns.round(3).tolist()
        self.evaluations += [Evaluation(step, i, each) for i, each in enumerate(rounded)]
        mean = float(np.mean(rounded))
        logger.record("evaluation/mean_return", mean)
        logger.dump(step)
        return mean

    def resume(
        self, episodes: list[Episode], evaluations: list[Evaluation], seconds: float, step: int
    ) -> None:
        """Continue from an earlier process's record, made at that step."""
        self.episodes, self.evaluations = episodes, evaluations
        self.earlier_seconds, self.first_step = seconds, step


class Scalars(TensorBoardOutputFormat):
    """TensorBoard's file after a step; later ones of an earlier process are hidden."""

    def __init__(self, folder: Path, step: int):
        self.writer = SummaryWriter(str(folder), purge_step=step + 1)
        self._is_closed = False
