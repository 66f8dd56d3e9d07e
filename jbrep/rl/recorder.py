"""What is recorded while an agent learns."""

import time
from collections.abc import Callable
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


class NotFiniteError(ArithmeticError):
    """A loss or the policy is NaN or infinite: there is nothing more to learn."""


class Scalars(TensorBoardOutputFormat):
    """TensorBoard's file, on from a step: what an earlier process wrote past it is dropped."""

    def __init__(self, folder: Path, step: int):
        self.writer = SummaryWriter(str(folder), purge_step=step)
        self._is_closed = False


class Recorder(BaseCallback):
    """Episodes, evaluations, progress and checkpoints of an agent that learns.

    Args:
        evaluator: of its policy.
        evaluate_every: steps from one evaluation to the next; there is one before the first and
            one after the last, too.
        begin: is called once the agent is set up to learn.
        watch: is told of progress.
        save: writes a checkpoint.
        save_every: seconds from one checkpoint to the next.

    Attributes:
        episodes: of training, so far.
        evaluations: so far.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        evaluate_every: int,
        begin: Callable[[], None],
        watch: Watch,
        save: Callable[[], None],
        save_every: float,
    ):
        super().__init__()
        self.episodes: list[Episode] = []
        self.evaluations: list[Evaluation] = []
        self._evaluator, self._every = evaluator, evaluate_every
        self._begin, self._watch = begin, watch
        self._save, self._save_every = save, save_every
        self._saved = time.monotonic()
        self._mean: float | None = None  # return of the last evaluation

    @property
    def record(self) -> dict[str, Any]:
        """All of it, as plain JSON."""
        return {"episodes": self.episodes, "evaluations": self.evaluations}

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from such a record."""
        self.episodes = [Episode(*row) for row in record["episodes"]]
        self.evaluations = [Evaluation(*row) for row in record["evaluations"]]

    def _on_training_start(self) -> None:
        self._begin()

    def _on_rollout_start(self) -> None:
        check_finite(self.model)
        if not self.evaluations:
            self._evaluate()
        if time.monotonic() - self._saved >= self._save_every:
            self._save()
            self._saved = time.monotonic()
        self._watch(self.model.num_timesteps, self._mean)

    def _on_step(self) -> bool:
        for lane in np.flatnonzero(self.locals["dones"]).tolist():
            info = self.locals["infos"][lane]
            total, length = float(info["episode"]["r"]), int(info["episode"]["l"])
            self.episodes.append(
                Episode(self.num_timesteps, lane, total, length, info["non_finite"])
            )
        lanes = self.training_env.num_envs
        due = self.num_timesteps % self._every < lanes
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
        self.evaluations += [Evaluation(step, i, each) for i, each in enumerate(returns)]
        self._mean = float(np.mean(returns))
        self.logger.record("evaluation/mean_return", self._mean)
        self.logger.dump(step)


def check_finite(agent: BaseAlgorithm) -> None:
    """Make sure that the agent can go on.

    Raises:
        NotFiniteError: a loss of the last gradient step isn't finite, or a weight of the policy.
    """
    for name, value in agent.logger.name_to_value.items():
        if name.endswith("loss") and not np.isfinite(value):
            raise NotFiniteError(f"{name} is {value}")
    acts = getattr(agent, "actor", agent.policy)
    if not all(bool(torch.isfinite(p.sum())) for p in acts.parameters()):
        raise NotFiniteError("the policy's weights are not finite")
