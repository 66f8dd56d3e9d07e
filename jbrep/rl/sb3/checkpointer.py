"""Snapshots of stable-baselines3's agents, taken and continued from in training."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecMonitor

from jbrep.encoders.vec_env import JitterbugVecEnv
from jbrep.records.container import Tensors
from jbrep.rl import checkpoint
from jbrep.rl.checkpoint import LANES, CheckpointFile, Snapshot, StoppedError, without
from jbrep.rl.policy_file import acting

_ROLLOUT = ("_last_obs", "_last_episode_starts")
_UNSCALED = "_last_original_obs"  # before it was normalised
_EXPLORATION = ("exploration_mat", "exploration_matrices")
_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Checkpointer(BaseCallback):
    """Continues an agent from the run's snapshot, if there is one, and takes one now and then.

    It acts between rollouts, where an agent's state is complete, and comes after the callbacks
    that add to the history.

    Args:
        file: of the run's snapshots.
        save_every: seconds between them.
        stop: whether to save and stop now.

    Raises:
        InputError: the checkpoint is damaged, or of other settings or versions.
        StoppedError: (in training) `stop` said so.
    """

    def __init__(self, file: CheckpointFile, save_every: float, stop: Callable[[], bool]):
        super().__init__()
        self._file, self._save_every, self._stop = file, save_every, stop
        self._snapshot = file.read()
        self._draws: Tensors = {}  # of the snapshot, until the first rollout

    def _on_training_start(self) -> None:
        if self._snapshot:
            self._draws = self._snapshot.tensors
            with self._file.resuming():
                restore(self.model, self._snapshot)
            self._snapshot = None  # a replay buffer can be large

    def _on_rollout_start(self) -> None:
        if self._draws:  # state-dependent noise has just been drawn, for the second time
            _restore_draws(self.model, self._draws)
            self._draws = {}
        stopping = self._stop()
        if stopping or self._file.is_due(self._save_every):
            self._file.write(take(self.model))
        if stopping:
            raise StoppedError(self.model.num_timesteps)

    def _on_step(self) -> bool:
        return True


def take(agent: BaseAlgorithm) -> Snapshot:
    """Take a snapshot of an agent between two rollouts; its tensors share the agent's memory."""
    monitor, env = _envs(agent)
    kind, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - SB3 draws there
    tensors, counters = checkpoint.take(agent)
    tensors |= {f"{LANES}{name}": values for name, values in env.state.items()}
    tensors |= {f"noise.{i}": n.noise_prev for i, n in enumerate(_drifting_noises(agent))}
    tensors |= {f"rollout.{name}": getattr(agent, name) for name in _ROLLOUT}
    if agent.get_vec_normalize_env():
        tensors |= {_UNSCALED: getattr(agent, _UNSCALED)}
    tensors |= {"returns": monitor.episode_returns, "lengths": monitor.episode_lengths}
    tensors |= {"torch": torch.get_rng_state().numpy(), "numpy": np.asarray(keys)}
    if noise := _state_dependent_noise(agent):
        tensors |= {name: getattr(noise, name).detach().numpy() for name in _EXPLORATION}
    counters |= {
        "numpy": (kind, position, has_gauss, gauss),
        "action_space": agent.action_space.np_random.bit_generator.state,
    }
    if buffer := _buffer(agent):
        counters["buffer"] = (buffer.pos, buffer.full)
        tensors |= {f"buffer.{name}": values for name, values in _transitions(buffer).items()}
    return Snapshot(tensors, counters)


def restore(agent: BaseAlgorithm, snapshot: Snapshot) -> None:
    """Bring an agent that is set up to learn to where the snapshot was taken."""
    checkpoint.restore(agent, snapshot)
    tensors, counters = snapshot
    monitor, env = _envs(agent)
    if buffer := _buffer(agent):
        buffer.pos, buffer.full = counters["buffer"]
        for name, values in _transitions(buffer).items():
            values[:] = tensors[f"buffer.{name}"]
    for i, noise in enumerate(_drifting_noises(agent)):
        noise.noise_prev = tensors[f"noise.{i}"]
    for name in _ROLLOUT:
        setattr(agent, name, tensors[f"rollout.{name}"])
    if agent.get_vec_normalize_env():
        setattr(agent, _UNSCALED, tensors[_UNSCALED])
    monitor.episode_returns, monitor.episode_lengths = tensors["returns"], tensors["lengths"]
    env.restore(without(LANES, tensors))
    agent.action_space.np_random.bit_generator.state = counters["action_space"]
    _restore_draws(agent, tensors)
    kind, *rest = counters["numpy"]
    np.random.set_state((kind, tensors["numpy"], *rest))  # noqa: NPY002


def _restore_draws(agent: BaseAlgorithm, tensors: Tensors) -> None:
    """Bring torch's generator, and what was drawn from it last, to where they were."""
    torch.set_rng_state(torch.from_numpy(tensors["torch"]))
    if noise := _state_dependent_noise(agent):
        for name in _EXPLORATION:
            setattr(noise, name, torch.from_numpy(tensors[name]))


def _state_dependent_noise(agent: BaseAlgorithm) -> StateDependentNoiseDistribution | None:
    """The distribution that explores by noise on features, with use_sde."""
    distribution = getattr(acting(agent.policy), "action_dist", None)
    is_one = isinstance(distribution, StateDependentNoiseDistribution)
    return distribution if is_one else None


def _envs(agent: BaseAlgorithm) -> tuple[VecMonitor, JitterbugVecEnv]:
    normalizer = agent.get_vec_normalize_env()
    monitor = normalizer.venv if normalizer else agent.env
    assert isinstance(monitor, VecMonitor)
    env = monitor.unwrapped
    assert isinstance(env, JitterbugVecEnv)
    return monitor, env


def _buffer(agent: BaseAlgorithm) -> ReplayBuffer | None:
    return getattr(agent, "replay_buffer", None)


def _transitions(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    """Views of the filled part of the buffer."""
    size = buffer.buffer_size if buffer.full else buffer.pos
    return {name: getattr(buffer, name)[:size] for name in _TRANSITIONS}


def _drifting_noises(agent: BaseAlgorithm) -> list[OrnsteinUhlenbeckActionNoise]:
    """The action noise of each lane, where it depends on its last value."""
    noise = getattr(agent, "action_noise", None)
    noises = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
    return [n for n in noises if isinstance(n, OrnsteinUhlenbeckActionNoise)]
