"""Learning, side by side in one run: python benchmarks/learning.py.

DDPG as in Table I on JitterbugVecEnv, against the same on shimmy's wrapper of the dm_control
domain, each in a process of one thread, in rounds taken in turn; and a study against bare runs.
"""

import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.wrappers import FlattenObservation
from shimmy import DmControlCompatibilityV0
from stable_baselines3 import DDPG
from timing import show, timed

from jbrep import jitterbug
from jbrep.encoders import find
from jbrep.envs import describe
from jbrep.rl import train
from jbrep.rl.agent import make_agent, make_env, noise_of
from jbrep.rl.presets import get_preset
from jbrep.studies.config import Study
from jbrep.studies.plan import Plan
from jbrep.studies.runner import on_this_machine, run_study

TASK = "face_direction"
ROUNDS = 12
STEPS = 200  # two rollouts of Table I, with 50 gradient steps each
STUDY = Study(
    tasks=(TASK,),
    algorithms=("sac-modern",),
    representations=("full", "dae-8"),
    seeds=(0, 1, 2, 3),
    steps=1500,
    evaluate_every=1500,
    evaluation_episodes=2,
)
STUDY_ROUNDS = 2


@cache  # its process makes it once
def agent_on_shimmy() -> Any:
    torch.set_num_threads(1)
    preset = get_preset("paper", "ddpg")
    environment = FlattenObservation(DmControlCompatibilityV0(jitterbug.load(TASK, seed=0)))
    network = {"net_arch": list(preset.net_arch), "activation_fn": torch.nn.ReLU}
    assert preset.noise
    noise = noise_of(preset.noise, 1, 1000)
    kwargs: dict[str, Any] = {
        "seed": 0,
        "device": "cpu",
        "policy_kwargs": network,
        **preset.algorithm_kwargs,
    }
    return DDPG("MlpPolicy", environment, **kwargs, action_noise=noise).learn(4 * STEPS)


@cache
def agent_on_jbrep() -> Any:
    torch.set_num_threads(1)
    preset = get_preset("paper", "ddpg")
    task = describe(TASK)
    environment = make_env(task, preset, 0, find("full", task))
    return make_agent("ddpg", preset, environment, 0).learn(4 * STEPS)


def seconds_a_step(make: Callable[[], Any]) -> float:
    agent = make()
    return timed(lambda: agent.learn(STEPS, reset_num_timesteps=False)) / STEPS


def seconds_of_gradients(make: Callable[[], Any]) -> float:
    """Of the gradient steps alone, for a step of the environment."""
    agent = make()
    return timed(lambda: agent.train(STEPS // 2, agent.batch_size)) / STEPS


def compare_loops() -> None:
    context = get_context("spawn")
    sides = agent_on_shimmy, agent_on_jbrep
    pools = [ProcessPoolExecutor(1, mp_context=context) for _ in sides]
    rounds = []
    for _ in range(ROUNDS + 1):
        whole = [p.submit(seconds_a_step, s).result() for p, s in zip(pools, sides, strict=True)]
        bare = [
            p.submit(seconds_of_gradients, s).result() for p, s in zip(pools, sides, strict=True)
        ]
        rounds.append((*whole, *bare))
    shimmy, ours, gradients_of_shimmy, gradients = np.array(rounds[1:]).T  # the first one warms up
    print(
        f"DDPG as in Table I: {1 / np.median(ours):.0f} steps/s, shimmy {1 / np.median(shimmy):.0f}"
    )
    show("times shimmy's rate", shimmy / ours, "aim 1.3")
    show("the same without gradient steps", (shimmy - gradients_of_shimmy) / (ours - gradients))
    show("part of a step that is gradient steps", gradients / ours)
    show("times shimmy's rate if all else took no time", shimmy / gradients)


def seconds_of_study(workers: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        plan = Plan(STUDY, Path(folder) / "study")
        return timed(lambda: run_study(plan, on_this_machine, workers))


def seconds_of_runs() -> float:
    with tempfile.TemporaryDirectory() as folder:
        plan = Plan(STUDY, Path(folder) / "bare")
        return timed(lambda: [train(plan.run(cell), plan.folder_of(cell)) for cell in plan.cells])


def compare_studies() -> None:
    torch.set_num_threads(1)
    rounds = [
        (seconds_of_runs(), seconds_of_study(1), seconds_of_study(2)) for _ in range(STUDY_ROUNDS)
    ]
    bare, one, two = np.array(rounds).T
    runs = len(Plan(STUDY, Path()).cells)
    print(f"a study of {runs} runs of {STUDY.steps:,} steps, {os.cpu_count()} cores")
    show("two workers, times the rate of one", one / two, "aim 1.85")
    show("one worker, times the time of the bare runs", one / bare, "aim 1.03")


if __name__ == "__main__":
    compare_loops()
    compare_studies()
