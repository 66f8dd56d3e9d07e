"""The record of an agent that stable-baselines3 trains: episodes, evaluations, progress."""

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from jbrep.rl.agent import Evaluator
from jbrep.rl.files import Episode
from jbrep.rl.history import WEIGHTS_NOT_FINITE, DivergedError, History, Watch
from jbrep.rl.policy_file import acting
from jbrep.rl.record import RunSettings


class Recorder(BaseCallback):
    """Records an agent's training: its episodes, evaluations and progress.

    The policy is evaluated before the first step, after the last, and at intervals in between.

    Args:
        history: to record in.
        evaluator: of the policy.
        settings: of the run that is recorded.
        watch: called with the progress before each rollout.
    """

    def __init__(self, history: History, evaluator: Evaluator, settings: RunSettings, watch: Watch):
        super().__init__()
        self._history, self._evaluator = history, evaluator
        self._settings, self._watch = settings, watch
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
        if self._settings.is_evaluation_due(self.num_timesteps, self.training_env.num_envs):
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        check_finite(self.model)
        self._watch(self.model.num_timesteps, self._mean)  # the last evaluation can take minutes
        self._evaluate()
        self._watch(self.model.num_timesteps, self._mean)

    def _evaluate(self) -> None:
        step = self.model.num_timesteps
        episodes = self._settings.episodes_at(step)
        returns = self._evaluator.returns(self.model, episodes)
        self._mean = self._history.evaluated(step, returns, self.logger)


def check_finite(agent: BaseAlgorithm) -> None:
    """Check the last losses and the policy's weights.

    Raises:
        DivergedError: one is NaN or infinite.
    """
    for name, value in agent.logger.name_to_value.items():
        if name.endswith("loss") and not np.isfinite(value):
            raise DivergedError(f"{name} is {value}")
    if not all(bool(torch.isfinite(p.sum())) for p in acting(agent.policy).parameters()):
        raise DivergedError(WEIGHTS_NOT_FINITE)
