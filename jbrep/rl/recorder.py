"""The record of a run: training episodes, evaluations, TensorBoard's scalars, progress."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter

from jbrep.rl.agent import Evaluator
from jbrep.rl.files import Episode, Evaluation

Watch = Callable[[int, float | None], None]  # steps so far; mean return of the last evaluation


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

    def as_json(self) -> dict[str, Any]:
        """A record that `resume` takes."""
        return {
            "episodes": self.episodes,
            "evaluations": self.evaluations,
            "seconds": self.seconds,
        }

    def resume(self, record: Mapping[str, Any], step: int) -> None:
        """Continue from an earlier process's record, made at that step."""
        self.episodes = [Episode(*row) for row in record["episodes"]]
        self.evaluations = [Evaluation(*row) for row in record["evaluations"]]
        self.earlier_seconds = float(record["seconds"])
        self.first_step = step


class Scalars(TensorBoardOutputFormat):
    """TensorBoard's file from a step on; later steps of an earlier process are hidden."""

    def __init__(self, folder: Path, step: int):
        self.writer = SummaryWriter(str(folder), purge_step=step)
        self._is_closed = False


class Recorder(BaseCallback):
    """Records an agent's training: its episodes, evaluations and progress.

    The policy is evaluated before the first step, after the last, and at intervals in between.

    Args:
        history: to record in.
        evaluator: of the policy.
        evaluate_every: steps from one evaluation to the next.
        watch: called with the progress before each rollout.
    """

    def __init__(self, history: History, evaluator: Evaluator, evaluate_every: int, watch: Watch):
        super().__init__()
        self._history, self._evaluator = history, evaluator
        self._every, self._watch = evaluate_every, watch
        self._mean: float | None = None  # return of the last evaluation

    def _on_rollout_start(self) -> None:
        check_finite(self.model)
        if not self._history.evaluations:
            self._evaluate()
        self._watch(self.model.num_timesteps, self._mean)

    def _on_step(self) -> bool:
        for lane in np.flatnonzero(self.locals["dones"]).tolist():
            info = self.locals["infos"][lane]
            total, length = float(info["episode"]["r"]), int(info["episode"]["l"])
            diverged = info.get("non_finite", False)
            self._history.episodes.append(
                Episode(self.num_timesteps, lane, total, length, diverged)
            )
        due = self.num_timesteps % self._every < self.training_env.num_envs
        if due and self.num_timesteps < self.model._total_timesteps:
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        check_finite(self.model)
        self._evaluate()
        self._watch(self.model.num_timesteps, self._mean)

    def _evaluate(self) -> None:
        step = self.model.num_timesteps
        returns = self._evaluator.returns(self.model).round(3).tolist()
        self._history.evaluations += [Evaluation(step, i, each) for i, each in enumerate(returns)]
        self._mean = float(np.mean(returns))
        self.logger.record("evaluation/mean_return", self._mean)
        self.logger.dump(step)


def check_finite(agent: BaseAlgorithm) -> None:
    """Check the last losses and the policy's weights.

    Raises:
        DivergedError: one is NaN or infinite.
    """
    for name, value in agent.logger.name_to_value.items():
        if name.endswith("loss") and not np.isfinite(value):
            raise DivergedError(f"{name} is {value}")
    actor = getattr(agent, "actor", agent.policy)
    if not all(bool(torch.isfinite(p.sum())) for p in actor.parameters()):
        raise DivergedError("the policy's weights are not finite")
