"""How long runs take, estimated from a short trial."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import gcd
from pathlib import Path
from tempfile import TemporaryDirectory

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from jbrep.rl.agent import Evaluator, make_agent, make_env
from jbrep.rl.cohort.cohort import Cohort
from jbrep.rl.cohort.member import Member
from jbrep.rl.job import Job
from jbrep.rl.names import COHORT
from jbrep.rl.presets import ALGORITHMS
from jbrep.rl.run import Run
from jbrep.training.trainer import single_torch_thread

_MIN_STEPS = 300  # of all runs


def estimate(runs: Sequence[Run]) -> float:
    """Seconds that runs take, together, on one core of this machine with nothing else running.

    Args:
        runs: that can be in one cohort, or one of another trainer.
    """
    first = runs[0]
    if issubclass(ALGORITHMS[first.algorithm], OffPolicyAlgorithm):
        runs = [replace(run, settings={**run.settings, **_at_once(run)}) for run in runs]
    with TemporaryDirectory() as folder, single_torch_thread():
        trial = _together if first.trainer == COHORT else _alone
        per_step, per_evaluation = trial(runs, Path(folder))
    at_end = first.final_episodes / first.evaluation_episodes
    evaluations = first.steps // first.evaluate_every + at_end
    return first.steps * per_step + evaluations * per_evaluation


def _at_once(run: Run) -> dict[str, int]:
    """Settings with gradient steps from the first rollout on, in rollouts as short as can be."""
    used = run.used.settings
    every, many = used.get("train_freq"), used.get("gradient_steps")
    if type(every) is not int or type(many) is not int or many < 1:
        return {"learning_starts": 0}
    shared = gcd(every, many)
    return {
        "learning_starts": 0,
        "train_freq": every // shared,
        "gradient_steps": many // shared,
    }


def _alone(runs: Sequence[Run], folder: Path) -> tuple[float, float]:
    """Seconds of a step, and of an evaluation."""
    (run,) = runs
    encoder, preset = run.find_encoder(), run.used
    env = make_env(run.task, preset.num_envs, 0, encoder, preset.normalize)
    agent = make_agent(run.algorithm, preset, env, 0)
    evaluator = Evaluator(run.task, encoder, run.evaluation_episodes)
    learned = _seconds(lambda: agent.learn(_MIN_STEPS))  # whole rollouts, so at least one
    return learned / agent.num_timesteps, _seconds(lambda: evaluator.returns(agent))


def _together(runs: Sequence[Run], folder: Path) -> tuple[float, float]:
    """The same of a cohort: a step of each run, an evaluation of each."""
    members = [Member(Job(run, folder / str(i)), []) for i, run in enumerate(runs)]
    cohort = Cohort(members)

    def learn() -> None:
        while cohort.step * len(runs) < _MIN_STEPS:
            for _ in range(cohort.rollout):
                cohort.act()
            cohort.learn()

    return _seconds(learn) / cohort.step, _seconds(members[0].evaluate) * len(members)


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
