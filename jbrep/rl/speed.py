"""How long runs take, estimated from a short trial."""

import time
from collections.abc import Callable, Sequence
from math import gcd
from pathlib import Path
from tempfile import TemporaryDirectory

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from jbrep.rl.agent import Evaluator, make_agent, make_env
from jbrep.rl.cohort.cohort import Cohort
from jbrep.rl.cohort.member import Member
from jbrep.rl.job import Job
from jbrep.rl.presets import sb3_class
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
    if issubclass(sb3_class(first.learner.algorithm), OffPolicyAlgorithm):
        runs = [run.replace(learner=run.learner.overridden(_at_once(run))) for run in runs]
    with TemporaryDirectory() as folder, single_torch_thread():
        jobs = [Job(run, Path(folder) / str(i)) for i, run in enumerate(runs)]
        settings = jobs[0].settings
        trial = _together if settings.trainer == COHORT else _alone
        per_step, per_evaluation = trial(jobs)
    at_end = settings.final_episodes / first.evaluation_episodes
    evaluations = first.steps // first.evaluate_every + at_end
    return first.steps * per_step + evaluations * per_evaluation


def _at_once(run: Run) -> dict[str, int]:
    """Settings with gradient steps from the first rollout on, in rollouts as short as can be."""
    used = run.learner.hyperparameters.algorithm_kwargs
    every, many = used.get("train_freq"), used.get("gradient_steps")
    if type(every) is not int or type(many) is not int or many < 1:
        return {"learning_starts": 0}
    shared = gcd(every, many)
    return {
        "learning_starts": 0,
        "train_freq": every // shared,
        "gradient_steps": many // shared,
    }


def _alone(jobs: Sequence[Job]) -> tuple[float, float]:
    """Seconds of a step, and of an evaluation."""
    (job,) = jobs
    run, chosen = job.run, job.settings.hyperparameters
    env = make_env(run.task, chosen.num_envs, 0, job.encoder, chosen.normalize)
    agent = make_agent(run.learner.algorithm, chosen, env, 0)
    evaluator = Evaluator(run.task, job.encoder, run.evaluation_episodes)
    learned = _seconds(lambda: agent.learn(_MIN_STEPS))  # whole rollouts, so at least one
    return learned / agent.num_timesteps, _seconds(lambda: evaluator.returns(agent))


def _together(jobs: Sequence[Job]) -> tuple[float, float]:
    """The same of a cohort: a step of each run, an evaluation of each."""
    members = [Member(job, []) for job in jobs]
    cohort = Cohort(members)

    def learn() -> None:
        while cohort.step * len(jobs) < _MIN_STEPS:
            for _ in range(cohort.rollout):
                cohort.act()
            cohort.learn()

    return _seconds(learn) / cohort.step, _seconds(members[0].evaluate) * len(members)


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
