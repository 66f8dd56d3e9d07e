"""Agents of 64 robots each, against bare physics and stable-baselines3: python benchmarks/wide.py.

SAC agents of the preset wide learn on all cores, in a process or in one for each core; one agent
learns alone, as jbrep rl does it. Rounds are taken in turn. With --device cuda, gradient steps are
on the GPU, those of stable-baselines3 aside.
"""

import argparse
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from joblib import cpu_count
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from throughput import bare_physics
from timing import show, timed

from jbrep.jitterbug.model import stop_profiling
from jbrep.rl import Run
from jbrep.rl.agent import make_agent, make_env, unchecked_distributions
from jbrep.rl.cohort.cohort import Cohort
from jbrep.rl.cohort.member import Member
from jbrep.rl.cohort.replay import capacity_of
from jbrep.rl.job import Job
from jbrep.rl.settings import BFLOAT16, CPU, CUDA, FLOAT32, PRECISIONS

TASK = "move_in_direction"
IN_MEMORY, ROBOTS = 4, 64
ROLLOUTS = 6  # steps of all robots, of a round
PAPER_STEPS = 5_000_000
AT_START = {"learning_starts": 0}


def run_of(seed: int, **settings: str) -> Run:
    """A run that learns from its first step on, and keeps a million transitions."""
    return Run.of(TASK, "sac", "wide", AT_START, seed=seed, **settings)


@cache  # its process makes it once
def cohort(agents: int, threads: int, precision: str, device: str = CPU) -> Cohort:
    """Agents with some transitions to learn from, whose robots are stepped on so many threads."""
    torch.set_num_threads(1)
    folder = Path(tempfile.mkdtemp())
    jobs = [
        Job(run_of(i, precision=precision, device=device), folder / str(i), threads)
        for i in range(agents)
    ]
    made = Cohort([Member(job, []) for job in jobs])
    made.begin()
    learn(made, 4)
    return made


def learn(cohort: Cohort, rollouts: int) -> None:
    """Step all robots so often, with the gradient steps."""
    with unchecked_distributions():
        for _ in range(rollouts):
            cohort.act()
            cohort.learn()


def rate_of_cohort(agents: int, threads: int, precision: str, device: str, _: int = 0) -> float:
    """Steps of a robot in a second."""
    made = cohort(agents, threads, precision, device)
    before, seconds = made.step, timed(lambda: learn(made, ROLLOUTS))
    return agents * (made.step - before) / seconds


@cache
def agent() -> OffPolicyAlgorithm:
    """One that stable-baselines3 trains."""
    torch.set_num_threads(1)
    run = run_of(0, trainer="sb3")
    repeat = run.learner.hyperparameters.action_repeat
    env = make_env(run.task, ROBOTS, 0, run.find_encoder(), action_repeat=repeat)
    made = make_agent("sac", run.learner.hyperparameters, env, 0)
    assert isinstance(made, OffPolicyAlgorithm)
    return made.learn(4 * ROBOTS)


def rate_of_agent(_: int) -> float:
    """The same of stable-baselines3."""
    made, actions = agent(), ROLLOUTS * ROBOTS
    seconds = timed(lambda: made.learn(actions, reset_num_timesteps=False))
    return run_of(0).learner.hyperparameters.action_repeat * actions / seconds


def rate_of_physics(robots: int) -> float:
    """The same of physics alone, on all cores."""
    step = physics(robots)
    return robots * ROLLOUTS / timed(lambda: [step() for _ in range(ROLLOUTS)])


physics = cache(lambda robots: bare_physics(robots, cpu_count()))


def evaluation_share(rate: float) -> float:
    """Of a run's time with the usual settings, if it makes so many steps a second."""
    made = cohort(1, cpu_count(), FLOAT32)
    job = made.members[0].job
    settings, seconds = job.settings, []
    made.write_to_agents()
    seconds.append(timed(lambda: job.evaluator.outcome(made.members[0].agent)))
    before_last = settings.steps / settings.evaluate_every
    last = settings.final_episodes / settings.evaluation_episodes
    evaluating = (before_last + last) * float(np.median(seconds))
    return evaluating / (evaluating + settings.steps / rate)


def peak_memory() -> float:
    """Of four agents whose replay buffers are full [GB], and the buffers alone."""
    made = cohort(IN_MEMORY, cpu_count(), FLOAT32)
    capacity = capacity_of(made.members[0].job.run)
    part = made._replay.rows_of(0)[:1]
    rows = np.broadcast_to(part, (capacity // ROBOTS, *part.shape[1:]))
    made._replay.restore([rows] * IN_MEMORY, len(rows))
    learn(made, 2)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default=CPU, choices=(CPU, CUDA))
    parser.add_argument("--agents", type=int, default=max(4, cpu_count()))
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    stop_profiling()
    agents, device, cores = given.agents, given.device, cpu_count()
    each = max(1, agents // cores)
    spawn = get_context("spawn")
    sides = {
        f"one process, {p}": partial(rate_of_cohort, agents, cores, p, device) for p in PRECISIONS
    }
    rates: dict[str, list[float]] = {}

    def measure(name: str, rate: float) -> None:
        rates.setdefault(name, []).append(rate)

    with ProcessPoolExecutor(cores, spawn) as ours, ProcessPoolExecutor(cores, spawn) as theirs:
        for _ in range(given.rounds + 1):
            measure("physics", rate_of_physics(agents * ROBOTS))
            for name, side in sides.items():
                measure(name, side())
            for p in PRECISIONS:
                work = partial(rate_of_cohort, each, 1, p, device)
                measure(f"one on each core, {p}", sum(ours.map(work, range(cores))))
            measure("stable-baselines3", sum(theirs.map(rate_of_agent, range(cores))))
            measure("physics of one", rate_of_physics(ROBOTS))
            for p in PRECISIONS:
                measure(f"alone, {p}", rate_of_cohort(1, cores, p, device))
    of = {name: np.array(values[1:]) for name, values in rates.items()}  # the first warms up

    print(f"{agents} SAC agents of {ROBOTS} robots, {cores} cores, {device}, {time.strftime('%F')}")
    show("bare physics of all, steps of a robot a second", of["physics"])
    for name in (n for n in of if n.startswith("one ")):
        show(f"cohorts, {name}: share of that", of[name] / of["physics"], ">= 0.5")
        show(
            f"cohorts, {name}: times stable-baselines3",
            of[name] / of["stable-baselines3"],
            ">= 1.5",
        )
    for p in (FLOAT32, BFLOAT16):
        seconds = PAPER_STEPS / of[f"alone, {p}"]
        show(f"one agent, {p}: hours for {PAPER_STEPS:,} steps", seconds / 3600)
        show("times its bare physics", of["physics of one"] / of[f"alone, {p}"])
    rate = float(np.median(of[f"alone, {FLOAT32}"]))
    show("share of evaluations in its time", [evaluation_share(rate) for _ in range(3)], "<= 0.15")
    with ProcessPoolExecutor(1, spawn) as other:
        show("memory of four agents with full buffers [GB]", [other.submit(peak_memory).result()])


if __name__ == "__main__":
    main()
