"""A stable-baselines3 agent from a preset, and how well its policy does."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecMonitor

from jbrep.encoders import Encoder
from jbrep.envs.sb3 import JitterbugVecEnv
from jbrep.rl.files import EVALUATION_SEED
from jbrep.rl.presets import ALGORITHMS, Preset


def make_env(task: str, num_envs: int, seed: int, encoder: Encoder) -> VecMonitor:
    """Jitterbugs seen through an encoder, on one thread."""
    return VecMonitor(JitterbugVecEnv(task, num_envs, seed, encoder, num_threads=1))


def training_seed(seed: int) -> int:
    """The environment's seed in the run of that seed: lanes of different runs share none."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0]) >> 1


def make_agent(algorithm: str, preset: Preset, env: VecMonitor, seed: int) -> BaseAlgorithm:
    """An agent that hasn't learned yet, on the CPU."""
    settings: dict[str, Any] = {**preset.settings}
    if preset.noise:
        settings["action_noise"] = preset.noise.make()
    return ALGORITHMS[algorithm](
        "MlpPolicy",
        env,
        seed=seed,
        device="cpu",
        policy_kwargs={
            "net_arch": list(preset.hidden),
            "activation_fn": torch.nn.ReLU,
            "optimizer_kwargs": {"fused": True, **preset.optimizer},  # same Adam, less overhead
        },
        **settings,
    )


class Evaluator:
    """Runs deterministic policies on the same episodes each time.

    Args:
        task: a key of TASKS.
        encoder: what the policy sees through.
        episodes: how many.
        seed: of the first; the others follow.
    """

    def __init__(self, task: str, encoder: Encoder, episodes: int, seed: int = EVALUATION_SEED):
        self._env = make_env(task, episodes, seed, encoder)
        self._seed = seed

    def returns(self, policy: BasePolicy | BaseAlgorithm) -> NDArray[np.float64]:
        """The return of each episode, (episodes,)."""
        self._env.seed(self._seed)
        episodes = self._env.num_envs
        returns, _ = evaluate_policy(
            policy, self._env, n_eval_episodes=episodes, return_episode_rewards=True
        )
        return np.asarray(returns, dtype=np.float64)
