"""Agents that learn together, against one after the other: python benchmarks/cohorts.py.

A gradient step alone; learning on all cores, a process on each; and a whole study. Rounds are taken
in turn. With --device cuda, the cohorts' gradient steps are on the GPU, and one process has all.
"""

import argparse
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from joblib import cpu_count
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from timing import show, timed

from jbrep.rl import Run
from jbrep.rl.agent import make_agent, make_env
from jbrep.rl.cohort.cohort import Cohort
from jbrep.rl.cohort.member import Member
from jbrep.rl.job import Job
from jbrep.rl.settings import FLOAT32, PRECISIONS
from jbrep.study.config import Study
from jbrep.study.packing import usual_workers
from jbrep.study.plan import Plan
from jbrep.study.runner import on_this_machine, run_study

LEARNERS = (("ddpg", "paper"), ("sac", "modern"))
CODES = ("full", "dae-12", "dae-8", "dae-4")
MEMBERS = 10
ROUNDS = 3
STEPS = {"ddpg": 400, "sac": 200}  # of a round, whole rollouts
UPDATES = 20
PRODUCTS = ("aten::mm", "aten::bmm")
STUDY = Study(
    tasks=("face_direction",),
    algorithms=("sac-modern",),
    representations=CODES,
    seeds=(0, 1, 2, 3),
    steps=20_000,
)


def run_of(learner: tuple[str, str], number: int, **changes: str) -> Run:
    """A run that learns from its first rollout on."""
    algorithm, preset = learner
    return Run.of(
        task="face_direction",
        algorithm=algorithm,
        preset=preset,
        overrides={"learning_starts": 0},
        encoder=CODES[number % len(CODES)],
        seed=number,
        **changes,
    )


@cache  # its process makes it once
def agent(learner: tuple[str, str], number: int) -> OffPolicyAlgorithm:
    """That stable-baselines3 trains, with some transitions to learn from."""
    torch.set_num_threads(1)
    run = run_of(learner, number, trainer="sb3")
    env = make_env(run.task, run.learner.hyperparameters.num_envs, 0, run.find_encoder())
    made = make_agent(run.learner.algorithm, run.learner.hyperparameters, env, number)
    assert isinstance(made, OffPolicyAlgorithm)
    return made.learn(400)


@cache
def cohort(learner: tuple[str, str], members: int, precision: str, device: str) -> Cohort:
    """The same for several agents."""
    torch.set_num_threads(1)
    folder = Path(tempfile.mkdtemp())
    runs = [run_of(learner, i, precision=precision, device=device) for i in range(members)]
    made = Cohort([Member(Job(run, folder / str(run.seed)), []) for run in runs])
    made.begin()
    learn_together(made, 400)
    return made


def learn_together(cohort: Cohort, steps: int) -> None:
    """Take so many steps of each member."""
    end = cohort.step + steps
    while cohort.step < end:
        for _ in range(cohort.rollout):
            cohort.act()
        cohort.learn()


def seconds_of_agent(learner: tuple[str, str], number: int) -> float:
    """For a step of the environment and what is learned from it."""
    made, steps = agent(learner, number), STEPS[learner[0]]
    return timed(lambda: made.learn(steps, reset_num_timesteps=False)) / steps


def seconds_of_member(
    learner: tuple[str, str], members: int, precision: str, device: str, number: int
) -> float:
    """The same for each member of a cohort."""
    made, steps = cohort(learner, members, precision, device), STEPS[learner[0]]
    return timed(lambda: learn_together(made, steps)) / steps / members


def milliseconds_of_update(learner: tuple[str, str]) -> float:
    """Of an agent's gradient step."""
    made = agent(learner, 0)
    return timed(lambda: made.train(UPDATES, made.batch_size)) / UPDATES * 1e3


def milliseconds_together(learner: tuple[str, str], precision: str, device: str) -> float:
    """Of a member's gradient step."""
    made = cohort(learner, MEMBERS, precision, device)

    def update() -> None:
        for index in range(UPDATES):
            made.update(index)
        if device == "cuda":
            torch.cuda.synchronize()

    return timed(update) / UPDATES / MEMBERS * 1e3


def share_of_products(learner: tuple[str, str], device: str) -> float:
    """How much of a gradient step's time goes into products of matrices."""
    made = cohort(learner, MEMBERS, FLOAT32, device)
    with torch.profiler.profile() as profile:
        for index in range(UPDATES):
            made.update(index)
    taken = {each.key: each.self_cpu_time_total for each in profile.key_averages()}
    return float(sum(taken.get(name, 0) for name in PRODUCTS) / sum(taken.values()))


def compare_updates(learner: tuple[str, str], device: str) -> None:
    name = "-".join(learner)
    sides = [partial(milliseconds_of_update, learner)]
    sides += [partial(milliseconds_together, learner, each, device) for each in PRECISIONS]
    alone, *together = np.array([[side() for side in sides] for _ in range(ROUNDS + 1)])[1:].T
    show(f"{name}: a gradient step of stable-baselines3 [ms]", alone)
    for precision, each in zip(PRECISIONS, together, strict=True):
        show(f"{name}: one of each of {MEMBERS} agents, {precision} [ms]", each)
        show(f"{name}: times stable-baselines3's rate, {precision}", alone / each)
    if device == "cpu":
        shares = [share_of_products(learner, device) for _ in range(ROUNDS)]
        show(f"{name}: share of products of matrices in it, float32", shares)


def side_by_side(pool: ProcessPoolExecutor, work: Callable[[int], float], processes: int) -> float:
    """What all processes do in a second, if each call says how long one takes."""
    return float(sum(1 / np.array([*pool.map(work, [0] * processes)])))


def compare_learning(learner: tuple[str, str], device: str) -> None:
    name, cores = "-".join(learner), cpu_count()
    processes = 1 if device == "cuda" else cores
    members = max(1, MEMBERS // processes)
    works = [
        partial(seconds_of_member, learner, members, precision, device) for precision in PRECISIONS
    ]
    with ExitStack() as stack:
        first, *others = (
            stack.enter_context(ProcessPoolExecutor(size, mp_context=get_context("spawn")))
            for size in (cores, *(processes for _ in works))
        )
        rounds = []
        for _ in range(ROUNDS + 1):
            alone = side_by_side(first, partial(seconds_of_agent, learner), cores)
            together = [
                side_by_side(pool, work, processes)
                for pool, work in zip(others, works, strict=True)
            ]
            rounds.append([alone, *together])
    columns = np.array(rounds[1:]).T  # the first one warms up
    alone, ours = columns[0], columns[1:]
    show(f"{name}: stable-baselines3 in {cores} processes, steps of all a second", alone)
    for precision, each in zip(PRECISIONS, ours, strict=True):
        show(f"{name}: {processes} cohorts of {members}, {precision}, the same", each)
        show(f"{name}: times stable-baselines3's rate, {precision}", each / alone)


def compare_studies(steps: int, device: str) -> None:
    def measured(trainer: str, **changes: str) -> tuple[float, float]:
        study = STUDY.replace(steps=steps, trainer=trainer, **changes)
        with tempfile.TemporaryDirectory() as folder:
            plan, before = Plan(study, Path(folder) / "study"), sum(os.times()[:4])
            seconds = timed(lambda: run_study(plan, on_this_machine, usual_workers(plan)))
        return seconds, (sum(os.times()[:4]) - before) / seconds / cpu_count()

    alone, _ = measured("sb3")
    runs = len(Plan(STUDY, Path()).cells)
    print(f"a study of {runs} runs of {steps:,} steps, {os.cpu_count()} cores")
    for precision in PRECISIONS:
        together, busy = measured("cohort", device=device, precision=precision)
        show(f"cohorts, {precision} [s]", [together])
        show("their share of the cores' time", [busy])
        show("times the rate of stable-baselines3's workers", [alone / together])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--study-steps", type=int, default=4000, help="0 for no study")
    given = parser.parse_args()
    for each in LEARNERS:
        compare_updates(each, given.device)
        compare_learning(each, given.device)
    if given.study_steps:
        compare_studies(given.study_steps, given.device)
