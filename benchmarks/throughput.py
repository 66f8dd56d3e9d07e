"""Control steps per second, side by side in one run: python benchmarks/throughput.py.

Every way of stepping is timed in turn, round after round; a ratio is the median over the rounds,
so that a machine that slows down slows both sides of it.
"""

import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import count
from multiprocessing import get_context

import gymnasium
import numpy as np
from gymnasium.wrappers import FlattenObservation
from mujoco.batch import Batch
from shimmy import DmControlCompatibilityV0
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from timing import show

import jbrep.envs  # noqa: F401 (registers the environments)
from jbrep import JitterbugVecEnv, jitterbug
from jbrep.jitterbug import environment_id
from jbrep.jitterbug.simulation import PHYSICS_STEPS, fast_model, stop_profiling
from jbrep.jitterbug.tasks import EPISODE_STEPS

TASK = "move_in_direction"
NUM_ENVS = 64
THREADS = 2
WORKERS = (2, 4, 8)
ROUNDS = 60  # short ones, side by side: these machines' speed wanders
SECONDS = 0.1

Stepper = Callable[[], int]  # steps some robots once and returns how many


@cache  # its process makes it once
def dm_control_loop() -> Stepper:
    environment = jitterbug.load(TASK, seed=0)
    environment.reset()
    random = np.random.default_rng(0)

    def step() -> int:
        if environment.step(random.uniform(-1, 1, 1)).last():
            environment.reset()
        return 1

    return step


def sb3(environment: VecEnv) -> Stepper:
    environment.reset()
    random = np.random.default_rng(0)
    shape = (environment.num_envs, 1)

    def step() -> int:
        environment.step(random.uniform(-1, 1, shape).astype(np.float32))
        return environment.num_envs

    return step


def shimmy_env() -> gymnasium.Env:
    return FlattenObservation(DmControlCompatibilityV0(jitterbug.load(TASK)))


def jbrep_env() -> gymnasium.Env:
    return gymnasium.make(environment_id(TASK))


def subprocesses(make: Callable[[], gymnasium.Env], workers: int) -> Stepper:
    return sb3(SubprocVecEnv([make] * workers))


def bare_physics(envs: int, threads: int) -> Stepper:
    batch = Batch(fast_model(), envs, threads)
    control = batch.bind("ctrl")
    random = np.random.default_rng(0)
    steps = count()

    def step() -> int:
        if next(steps) % EPISODE_STEPS == 0:  # a robot that fell long ago is another load
            batch.reset()
        control[:] = random.uniform(-1, 1, (envs, 1))
        batch.step(nstep=PHYSICS_STEPS)
        return envs

    return step


def rate(step: Stepper) -> float:
    """Control steps per second."""
    step()
    steps, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < SECONDS:
        steps += step()
    return steps / elapsed


def rate_of_dm_control() -> float:
    """In a process of its own: jbrep takes MuJoCo's clock away, a user of dm_control has it."""
    return rate(dm_control_loop())


def main() -> None:
    plain = "dm_control in a loop"
    batched = f"jbrep, {NUM_ENVS} environments, {THREADS} threads"
    bare = f"bare physics, {NUM_ENVS} environments, {THREADS} threads"
    steppers = {
        **{
            f"SubprocVecEnv of dm_control, {n} workers": subprocesses(shimmy_env, n)
            for n in WORKERS
        },
        **{f"SubprocVecEnv of jbrep, {n} workers": subprocesses(jbrep_env, n) for n in WORKERS},
    }
    stop_profiling()
    steppers |= {
        batched: sb3(JitterbugVecEnv(TASK, NUM_ENVS, num_threads=THREADS)),
        bare: bare_physics(NUM_ENVS, THREADS),
        "jbrep, 1 environment": sb3(JitterbugVecEnv(TASK, 1, num_threads=1)),
        "bare physics, 1 environment": bare_physics(1, 1),
    }
    rates: dict[str, list[float]] = {name: [] for name in (plain, *steppers)}
    with ProcessPoolExecutor(1, get_context("spawn")) as elsewhere:
        for _ in range(ROUNDS):
            rates[plain].append(elsewhere.submit(rate_of_dm_control).result())
            for name, step in steppers.items():
                rates[name].append(rate(step))

    print(f"{TASK}, {os.cpu_count()} cores; median of {ROUNDS} rounds\n")
    print(f"{'':40} control steps/s")
    for name, values in rates.items():
        print(f"{name:40} {np.median(values):15,.0f}")

    def ratio(one: str, other: str) -> np.ndarray:
        return np.array(rates[one]) / np.array(rates[other])

    print("\nratio, median [10 %, 90 %], aim")
    best = max(
        (name for name in rates if name.startswith("SubprocVecEnv of dm")),
        key=lambda name: np.median(rates[name]),
    )
    show("batched / dm_control in a loop", ratio(batched, plain), ">= 2.8")
    show("batched / best SubprocVecEnv of dm_control", ratio(batched, best), ">= 2.4")
    show("batched / bare physics", ratio(batched, bare), ">= 0.92")
    single = ratio("bare physics, 1 environment", "jbrep, 1 environment")
    show("cost of one environment / bare physics", single, "<= 1.25")


if __name__ == "__main__":
    main()
