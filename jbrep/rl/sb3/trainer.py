"""Training runs with stable-baselines3, one at a time."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from jbrep.envs.lanes import EnvironmentFailedError, NonFiniteActionError
from jbrep.rl.agent import Evaluator, make_agent, make_env, training_seed, unchecked_distributions
from jbrep.rl.history import ACTIONS_NOT_FINITE, DivergedError
from jbrep.rl.job import Ended, Job, Session
from jbrep.rl.policy import begin
from jbrep.rl.record import RunRecord
from jbrep.rl.sb3.checkpointer import Checkpointer
from jbrep.rl.sb3.recorder import Recorder


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
