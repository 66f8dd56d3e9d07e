"""How long runs take, estimated from a short trial."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from math import gcd
from pathlib import Path
from tempfile import TemporaryDirectory

from stable_baselines3.common.base_class import BaseAlgorithm

from jbrep.rl.agent import make_agent, make_env
from jbrep.rl.cohort.cohort import Cohort
from jbrep.rl.cohort.member import Member
from jbrep.rl.job import Job
from jbrep.rl.overrides import is_off_policy
from jbrep.rl.run import Run
from jbrep.rl.settings import COHORT
from jbrep.training.trainer import single_torch_thread

_MIN_STEPS = 300  # of all runs


def estimate(runs: Sequence[Run]) -> float:
    """Seconds that runs take, together, on one core of this machine with nothing else running.

    Args:
        runs: that can be in one cohort, or one of another trainer.
    """
    first = runs[0]
    if is_off_policy(first.learner.algorithm):
        runs = [run.replace(learner=run.learner.overridden(_at_once(run))) for run in runs]
    with TemporaryDirectory() as folder, single_torch_thread(), ExitStack() as opened:
        jobs = [Job(run, Path(folder) / str(i)) for i, run in enumerate(runs)]
        for job in jobs:
            opened.callback(job.close)
        settings, evaluator = jobs[0].settings, jobs[0].evaluator
        trial = _together if settings.trainer == COHORT else _alone
        per_step, agent = trial(jobs, opened)
        per_evaluation = len(jobs) * _seconds(lambda: evaluator.outcome(agent))
    at_end = settings.final_episodes / first.evaluation_episodes
    evaluations = first.steps // settings.evaluate_every + at_end
    return first.steps * per_step + evaluations * per_evaluation


def _at_once(run: Run) -> dict[str, int]:
    """Settings with gradient steps from the first rollout on, in rollouts as short as can be."""
    used = run.learner.hyperparameters.algorithm_kwargs
    every, many = used.get("train_freq"), used.get("gradient_steps")
    if type(every) is not int or type(many) is not int or many < 1:
        return {"learning_starts": 0}
    every, many = every // gcd(every, many), many // gcd(every, many)
    return {"learning_starts": 0, "train_freq": every, "gradient_steps": many}


def _alone(jobs: Sequence[Job], opened: ExitStack) -> tuple[float, BaseAlgorithm]:
    """Seconds of a step, and an agent."""
    (job,) = jobs
    run, chosen = job.run, job.settings.hyperparameters
    env = make_env(
        run.task,
        chosen.num_envs,
        0,
        job.encoder,
        normalize=chosen.normalize,
        action_repeat=chosen.action_repeat,
    )
    opened.callback(env.close)
    agent = make_agent(run.learner.algorithm, chosen, env, 0, job.settings.episode_steps)
    learned = _seconds(lambda: agent.learn(_MIN_STEPS))  # whole rollouts, so at least one
    return learned / job.step_of(agent), agent


def _together(jobs: Sequence[Job], opened: ExitStack) -> tuple[float, BaseAlgorithm]:
    """The same of a cohort: a step of each run."""
    members = [Member(job, []) for job in jobs]
    for member in members:
        opened.callback(member.agent.logger.close)
    cohort = opened.enter_context(closing(Cohort(members)))
    cohort.begin()

    def learn() -> None:
        while cohort.step * len(jobs) < _MIN_STEPS:
            for _ in range(cohort.rollout):
                cohort.act()
            cohort.learn()

    return _seconds(learn) / cohort.step, cohort.members[0].agent


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
