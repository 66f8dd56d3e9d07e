"""A stable-baselines3 agent from a preset, and the evaluation of its policy."""

from collections.abc import Iterator
from contextlib import contextmanager
from operator import attrgetter
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from torch.distributions import Distribution

from jbrep.dae.adam import allocate_adam_state
from jbrep.envs.encoding import BaseEncoder
from jbrep.envs.lanes import Lanes
from jbrep.envs.recording import Actor, episode_returns
from jbrep.envs.sb3 import TaskVecEnv, agent_spaces
from jbrep.envs.task import Array, Task
from jbrep.rl.files import EVALUATION_SEED
from jbrep.rl.presets import ALGORITHMS, Preset


def make_env(task: Task, num_envs: int, seed: int, encoder: BaseEncoder) -> VecMonitor:
    """Lanes of a task seen through an encoder, stepped on one thread."""
    return VecMonitor(TaskVecEnv(task, num_envs, seed, encoder, num_threads=1))


class Spaces(gymnasium.Env[Any, Any]):
    """What a policy needs to know of a task to be built, without making the environment."""

    def __init__(self, task: Task, encoder: BaseEncoder):
        self.observation_space, self.action_space = agent_spaces(task, encoder)


def training_seed(seed: int) -> int:
    """The environment's seed in the run with this seed: no two runs share a lane's seed."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0]) >> 1


def make_agent(algorithm: str, preset: Preset, env: VecEnv | Spaces, seed: int) -> BaseAlgorithm:
    """An untrained agent on the CPU, with its optimisers' state allocated."""
    settings: dict[str, Any] = {**preset.settings}
    if preset.noise:
        size = np.prod(env.action_space.shape or (), dtype=int)
        settings["action_noise"] = preset.noise.make(int(size))
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


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """Let NaN through torch's distributions, which would raise a bare ValueError.

    It then shows in an action, a loss or a weight, each of which is checked.
    """
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def deterministic(policy: BasePolicy | BaseAlgorithm, encoder: BaseEncoder, task: Task) -> Actor:
    """The policy's most likely actions, within their bounds despite rounding.

    They are not finite where its weights aren't.
    """
    bounds = agent_spaces(task, encoder)[1]

    def act(observation: Array) -> NDArray[np.float32]:
        seen = encoder.encode(observation.astype(np.float32))
        with unchecked_distributions():
            actions = policy.predict(seen, deterministic=True)[0]
        return np.clip(actions, bounds.low, bounds.high)

    return act


class Evaluator:
    """Plays deterministic policies, in the same episodes each time.

    Args:
        task: what is played.
        encoder: the policy's view of the observation.
        episodes: the number of episodes.
        seed: of the first episode; the others take the numbers that follow.
    """

    def __init__(
        self, task: Task, encoder: BaseEncoder, episodes: int, seed: int = EVALUATION_SEED
    ):
        self._lanes = Lanes(task, episodes, num_threads=1)
        self._encoder, self._seed = encoder, seed

    def returns(self, policy: BasePolicy | BaseAlgorithm) -> Array:
        """The return of each episode, (episodes,).

        Raises:
            NonFiniteActionError: the policy's actions are not finite.
            EnvironmentFailedError: the environment fails in the middle of an episode.
        """
        act = deterministic(policy, self._encoder, self._lanes.task)
        return episode_returns(self._lanes, act, self._seed)
