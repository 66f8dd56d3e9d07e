"""One reinforcement-learning run: task, representation, algorithm, seed."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from jbrep.dataset.storage import make_folder
from jbrep.encoders import find
from jbrep.envs.sb3 import JitterbugVecEnv
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import get_task

ALGORITHMS: dict[str, Callable[..., BaseAlgorithm]] = {
    "ddpg": DDPG,
    "td3": TD3,
    "sac": partial(SAC, train_freq=2),  # one gradient step in two steps
    "ppo": PPO,
    "a2c": A2C,
}
EVALUATION_EPISODES = 10
_EVALUATION_SEED = 1_000_000  # past the seeds of training


@dataclass(frozen=True)
class Run:
    """What to train, with the paper's network and stable-baselines3's own settings."""

    task: str
    algorithm: str = "sac"
    encoder: str | None = None  # a file, a name that ships, or None for the full observation
    steps: int = 10_000
    seed: int = 0


def train(run: Run, folder: Path) -> dict[str, Any]:
    """Train, evaluate the deterministic policy, and write policy.zip and run.json.

    Returns:
        What run.json holds: the settings, and the evaluation's returns.

    Raises:
        InputError: unknown task or algorithm, an encoder of another task, or a finished run in
            the folder.
    """
    task = get_task(run.task)
    if run.algorithm not in ALGORITHMS:
        choices = ", ".join(ALGORITHMS)
        raise InputError(f"unknown algorithm {run.algorithm!r}: choose one of {choices}")
    if (folder / "run.json").exists():
        raise InputError(f"{folder} holds a finished run already: choose another folder")
    encoder = find(run.encoder, task.name) if run.encoder else None

    def make_env(num_envs: int, seed: int) -> VecEnv:
        return VecMonitor(JitterbugVecEnv(run.task, num_envs, seed, encoder))

    make_folder(folder)
    agent = ALGORITHMS[run.algorithm](
        "MlpPolicy",
        make_env(1, run.seed),
        seed=run.seed,
        device="cpu",
        policy_kwargs={"net_arch": [350, 250]},
    )
    agent.learn(run.steps, progress_bar=True)
    returns, _ = evaluate_policy(
        agent,
        make_env(EVALUATION_EPISODES, _EVALUATION_SEED + run.seed),
        n_eval_episodes=EVALUATION_EPISODES,
        return_episode_rewards=True,
    )
    agent.save(folder / "policy.zip")
    result = {
        "run": asdict(run),
        "representation": encoder.name if encoder else "full",
        "returns": np.asarray(returns).round(3).tolist(),
        "versions": {name: version(name) for name in ("jbrep", "mujoco", "stable-baselines3")},
    }
    (folder / "run.json").write_text(json.dumps(result, indent=2) + "\n")
    return result
