"""A stable-baselines3 agent from a preset, and the evaluation of its policy."""

from collections.abc import Iterator
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecMonitor

from jbrep.dae.adam import allocate_adam_state
from jbrep.encoders import Encoder
from jbrep.envs.sb3 import JitterbugVecEnv
from jbrep.jitterbug.tasks import EPISODE_STEPS
from jbrep.rl.files import EVALUATION_SEED
from jbrep.rl.presets import ALGORITHMS, Preset


def make_env(
    task: str, num_envs: int, seed: int, encoder: Encoder, episode_steps: int = EPISODE_STEPS
) -> VecMonitor:
    """Jitterbugs seen through an encoder, stepped on one thread."""
    env = JitterbugVecEnv(
        task, num_envs, seed, encoder, num_threads=1, max_episode_steps=episode_steps
    )
    return VecMonitor(env)


def training_seed(seed: int) -> int:
    """The environment's seed in the run with this seed: no two runs share a lane's seed."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0]) >> 1


def make_agent(algorithm: str, preset: Preset, env: VecMonitor, seed: int) -> BaseAlgorithm:
    """An untrained agent on the CPU, with its optimisers' state allocated."""
    settings: dict[str, Any] = {**preset.settings}
    if preset.noise:
        settings["action_noise"] = preset.noise.make()
    agent = ALGORITHMS[algorithm](
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
    for _, part in trained_parts(agent):
        if isinstance(part, torch.optim.Optimizer):
            allocate_adam_state(part)
    return agent


def trained_parts(agent: BaseAlgorithm) -> Iterator[tuple[str, Any]]:
    """The modules and optimisers that training changes, by stable-baselines3's names for them."""
    names, _ = agent._get_torch_save_params()
    return ((name, attrgetter(name)(agent)) for name in names)


class Evaluator:
    """Plays deterministic policies, in the same episodes each time.

    Args:
        task: a key of TASKS.
        encoder: the policy's view of the observation.
        episodes: the number of episodes.
        seed: of the first episode; the others take the numbers that follow.
        episode_steps: the length of an episode [control steps].
    """

    def __init__(
        self,
        task: str,
        encoder: Encoder,
        episodes: int,
        seed: int = EVALUATION_SEED,
        episode_steps: int = EPISODE_STEPS,
    ):
        self._env = make_env(task, episodes, seed, encoder, episode_steps)
        self._seed = seed

    def returns(self, policy: BasePolicy | BaseAlgorithm) -> NDArray[np.float64]:
        """The return of each episode, (episodes,)."""
        self._env.seed(self._seed)
        episodes = self._env.num_envs
        returns, _ = evaluate_policy(
            policy, self._env, n_eval_episodes=episodes, return_episode_rewards=True
        )
        return np.asarray(returns, dtype=np.float64)
