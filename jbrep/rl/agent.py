"""A stable-baselines3 agent from a preset, and the evaluation of its policy."""

import random
import textwrap
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import attrgetter
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from colorednoise import powerlaw_psd_gaussian
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
)
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from torch.distributions import Distribution

from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.vec_env import JitterbugVecEnv
from jbrep.envs.environments import Environments
from jbrep.envs.recording import Actor, Outcome, held, joined, whole_outcome
from jbrep.envs.task import Array, Task
from jbrep.errors import Notice, refusing
from jbrep.records.container import Tensors
from jbrep.records.record import to_plain
from jbrep.rl.files import EVALUATION_SEED
from jbrep.rl.normalization import Statistics, normalized
from jbrep.rl.presets import LINEAR, Hyperparameters, NormalNoise, OrnsteinUhlenbeckNoise, sb3_class
from jbrep.training.trainer import allocate_adam_state, single_torch_thread

Preprocess = Callable[[NDArray[np.float32]], NDArray[np.float32]]
ACTIVATIONS: dict[str, type[torch.nn.Module]] = {
    "relu": torch.nn.ReLU,
    "tanh": torch.nn.Tanh,
    "elu": torch.nn.ELU,
    "gelu": torch.nn.GELU,
    "silu": torch.nn.SiLU,
    "leaky_relu": torch.nn.LeakyReLU,
}


def make_env(
    task: Task,
    chosen: Hyperparameters,
    seed: int,
    encoder: BaseEncoder,
    threads: int = 1,
    retries: int = 0,
) -> VecEnv:
    """A task seen through an encoder, as hyperparameters say, stepped on threads."""
    envs = JitterbugVecEnv(
        task,
        chosen.num_envs,
        seed,
        encoder,
        num_threads=min(threads, chosen.num_envs),
        action_repeat=chosen.action_repeat,
        retries=retries,
    )
    return normalized(VecMonitor(envs)) if chosen.normalize else VecMonitor(envs)


def one_line(problem: object) -> str:
    """The text of an error, or of what else is to be named, for a message."""
    return textwrap.shorten(str(problem), 200)


class Spaces(gymnasium.Env[Any, Any]):
    """What a policy needs to know of a task to be built, without making the environment."""

    def __init__(self, observation_space: spaces.Box, action_space: spaces.Box):
        self.observation_space, self.action_space = observation_space, action_space


def acting(policy: BasePolicy) -> BasePolicy:
    """The part of a policy that chooses actions: without critics where they are apart."""
    return getattr(policy, "actor", policy)


def training_seed(seed: int) -> int:
    """The seed of the first environment in the run with this seed; the others count on."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0]) >> 1


def make_agent(
    algorithm: str,
    hyperparameters: Hyperparameters,
    env: VecEnv | Spaces,
    seed: int,
    episode_steps: int = 1000,
    device: str = "cpu",
) -> BaseAlgorithm:
    """An untrained agent, with its optimisers' state allocated.

    Its `action_repeat` is for whoever plays its policy, and in policy.zip. The steps of the longest
    episode are for noise that is drawn for an episode at once.
    """
    of_class = {name: _argument(v) for name, v in hyperparameters.algorithm_kwargs.items()}
    of_policy, of_adam = hyperparameters.policy_kwargs, hyperparameters.optimizer_kwargs
    if hyperparameters.noise:
        size = int(np.prod(env.action_space.shape or (), dtype=int))
        of_class["action_noise"] = noise_of(hyperparameters.noise, size, episode_steps)
    with (
        warnings.catch_warnings(record=True) as caught,
        refusing("not enough memory for the replay buffer", (MemoryError,), describe=one_line),
    ):
        agent: Any = sb3_class(algorithm)(
            "MlpPolicy",
            env,
            seed=seed,
            device=device,
            policy_kwargs={
                **of_policy,
                "net_arch": to_plain(hyperparameters.net_arch),
                "activation_fn": ACTIVATIONS[of_policy["activation_fn"]],
                "optimizer_kwargs": {"fused": True, **of_adam},  # same Adam, less overhead
            },
            **of_class,
        )
    for each in caught:
        warnings.warn(one_line(each.message), Notice, stacklevel=2)
    for _, part in trained_parts(agent):
        if isinstance(part, torch.optim.Optimizer):
            allocate_adam_state(part)
    agent.action_repeat = hyperparameters.action_repeat
    return cast("BaseAlgorithm", agent)


@contextmanager
def global_random_state_kept() -> Iterator[None]:
    """Leave the process's random numbers as they were: making an agent seeds them."""
    numpy_state = np.random.get_state()  # noqa: NPY002 - stable-baselines3 draws there
    python_state = random.getstate()
    try:
        with torch.random.fork_rng(devices=()):
            yield
    finally:
        np.random.set_state(numpy_state)  # noqa: NPY002
        random.setstate(python_state)


class ColouredActionNoise(ActionNoise):
    """Coloured noise of one environment, from the generator that stable-baselines3 draws from.

    On `size` numbers, for episodes of so many steps. `ahead` is drawn for the steps to come, (m,
    size).
    """

    def __init__(self, beta: float, sigma: float, size: int, steps: int):
        super().__init__()
        self._beta, self._sigma = beta, sigma
        self._shape = size, max(steps, 2)  # fewer have no spectrum
        self.ahead: NDArray[np.float64]
        self.reset()

    def __call__(self) -> NDArray[Any]:
        if not len(self.ahead):
            generator = np.random.mtrand._rand
            unit = powerlaw_psd_gaussian(self._beta, self._shape, random_state=generator)
            self.ahead = np.ascontiguousarray(self._sigma * unit.T)
        now, self.ahead = self.ahead[0], self.ahead[1:]
        return now.astype(np.float32)

    def reset(self) -> None:
        self.ahead = np.zeros((0, self._shape[0]))


def noise_of(chosen: Any, size: int, steps: int) -> ActionNoise:
    """stable-baselines3's noise of actions of a size, for episodes of so many steps."""
    match chosen:
        case NormalNoise(sigma=sigma):
            return NormalActionNoise(np.zeros(size), np.full(size, sigma))
        case OrnsteinUhlenbeckNoise(mean=mean, sigma=sigma, theta=theta):
            about, sigmas = np.full(size, mean), np.full(size, sigma)
            return OrnsteinUhlenbeckActionNoise(about, sigmas, theta)
        case _:
            return ColouredActionNoise(chosen.beta, chosen.sigma, size, steps)


def _argument(value: Any) -> Any:
    """A setting as stable-baselines3 takes it: schedules as functions, a frequency as a tuple."""
    if isinstance(value, str) and value.startswith(LINEAR):
        return LinearSchedule(float(value.removeprefix(LINEAR)), 0.0, 1.0)
    return tuple(value) if isinstance(value, list) else value


def trained_parts(agent: BaseAlgorithm) -> Iterator[tuple[str, Any]]:
    """The modules and optimisers that training changes, by stable-baselines3's names for them."""
    names, _ = agent._get_torch_save_params()
    return ((name, attrgetter(name)(agent)) for name in names)


def parameters(agent: BaseAlgorithm) -> Iterator[tuple[str, torch.Tensor]]:
    """Everything that gradient steps change: weights, targets, Adam's moments, entropy's weight."""
    _, variables = agent._get_torch_save_params()
    yield from ((name, getattr(agent, name).data) for name in variables)
    for name, part in trained_parts(agent):
        state = part.state_dict()
        if isinstance(part, torch.optim.Optimizer):
            moments = state["state"].items()
            state = {f"{i}.{key}": t for i, each in moments for key, t in each.items()}
        yield from ((f"{name}.{key}", t) for key, t in state.items())


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


def deterministic_actor(
    policy: BasePolicy, task: Task, preprocess: Preprocess, batch_size: int | None = None
) -> Actor:
    """The policy's most likely actions, within their bounds despite rounding.

    They are not finite where its weights aren't. A policy whose own actions are in [-1, 1] has them
    scaled to the task's bounds. What it sees of observations (n, d) is preprocessed. A network
    rounds differently in batches of other sizes; all rows are one if no size is given. Several
    actions that are chosen at once stand in one row.
    """
    policy.set_training_mode(False)
    low, high = (np.array(bound, np.float32) for bound in (task.action_low, task.action_high))

    def act(observation: Array) -> NDArray[np.float32]:
        size = batch_size or len(observation)
        batches = torch.from_numpy(observation.astype(np.float32)).split(size)
        with single_torch_thread(), torch.no_grad(), unchecked_distributions():
            chosen = [
                policy._predict(torch.from_numpy(preprocess(each.numpy())).to(policy.device), True)
                for each in batches
            ]
        actions = torch.cat(chosen).numpy(force=True)
        own = policy.unscale_action(actions) if policy.squash_output else actions
        own = task.unscale_action(own.reshape(-1, task.action_size)).astype(np.float32)
        return np.clip(own, low, high).reshape(actions.shape)

    return act


def preprocessor(encode: Preprocess, statistics: Statistics | None) -> Preprocess:
    """What a policy sees of observations: an encoder's latents, perhaps normalised."""
    return lambda rows: statistics(encode(rows)) if statistics else encode(rows)


def statistics_of(agent: BaseAlgorithm) -> Statistics | None:
    """Those by which an agent normalises what it sees, if it does."""
    env = agent.get_vec_normalize_env()
    return Statistics.of(env) if env else None


def restore_statistics(agent: BaseAlgorithm, tensors: Tensors) -> None:
    """Let an agent that normalises go on from the statistics among tensors."""
    if env := agent.get_vec_normalize_env():
        (size,) = env.observation_space.shape or ()
        Statistics.read(tensors, size).give(env)


def evaluate(
    agent: BaseAlgorithm, envs: Environments, encoder: BaseEncoder, episodes: int
) -> Outcome:
    """What comes of an agent's deterministic policy in the same episodes each time.

    What it normalises, it normalises by its statistics so far, which stay as they are.
    """
    preprocess = preprocessor(encoder.encode, statistics_of(agent))
    act = deterministic_actor(agent.policy, envs.task, preprocess)
    repeat = getattr(agent, "action_repeat", 1)
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + episodes, envs.num_envs)
    return joined((whole_outcome(envs, lambda: held(act, repeat), s) for s in seeds), episodes)
