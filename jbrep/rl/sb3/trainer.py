"""Training runs with stable-baselines3, one at a time."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from jbrep.envs.lanes import EnvironmentFailedError, NonFiniteActionError
from jbrep.rl.agent import Evaluator, make_agent, make_env, training_seed, unchecked_distributions
from jbrep.rl.files import Episode
from jbrep.rl.history import ACTIONS_NOT_FINITE, WEIGHTS_NOT_FINITE, DivergedError, History, Watch
from jbrep.rl.job import Ended, Job, Session
from jbrep.rl.policy import begin
from jbrep.rl.policy_file import acting
from jbrep.rl.record import RunRecord, RunSettings
from jbrep.rl.sb3.checkpointer import Checkpointer


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


def train_in_turn(jobs: Sequence[Job], session: Session) -> Iterator[Ended]:
    """Bring runs from their start or their checkpoints to their end, one after the other.

    Raises:
        InputError: a checkpoint can't be resumed.
        StoppedError: the session is to stop; the run's checkpoint is written.
    """
    return ((job, _train(job, session)) for job in jobs)


def _train(job: Job, session: Session) -> RunRecord:
    run, settings = job.run, job.settings
    chosen = settings.hyperparameters
    checkpointer = Checkpointer(job.checkpoint, session.save_every, session.stop)
    job.keep_encoder()
    seed = training_seed(run.seed)
    env = make_env(run.task, chosen.num_envs, seed, job.encoder, chosen.normalize)
    agent = make_agent(settings.algorithm, chosen, env, run.seed)
    env.seed(seed)  # stable-baselines3 gave it the agent's, which lanes of other runs share
    if settings.begin_from:
        begin(agent, Path(run.begin_from), settings.begin_from, job.folder)
    agent.set_logger(job.logger(session.writers))
    evaluator = Evaluator(run.task, job.encoder, run.evaluation_episodes)
    watch = partial(session.watch, job)
    recorder = Recorder(job.history, evaluator, settings, watch)
    failure = _learn(agent, run.steps, [recorder, checkpointer])
    return job.end(agent, failure)


def _learn(agent: BaseAlgorithm, steps: int, callbacks: Sequence[BaseCallback]) -> str:
    """Train up to that step; why training failed, or nothing."""
    try:
        with unchecked_distributions():
            agent.learn(steps, callback=[*callbacks])
    except (DivergedError, EnvironmentFailedError) as error:
        return str(error)
    except NonFiniteActionError:
        return ACTIONS_NOT_FINITE
    finally:
        agent.logger.close()
    return ""
