"""The checkpoint of a run, in a file that can't run code when it is read."""

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecMonitor

from jbrep.envs.lanes import EnvironmentFailedError
from jbrep.envs.sb3 import TaskVecEnv
from jbrep.errors import DamageError, InputError
from jbrep.files import container
from jbrep.files.container import Tensors
from jbrep.files.storage import exists
from jbrep.rl.agent import statistics_of, trained_parts
from jbrep.rl.fields import completed
from jbrep.rl.files import differing
from jbrep.rl.normalization import Statistics
from jbrep.rl.recorder import History

MAX_BYTES = 1 << 34
PARAMETERS = "parameters."  # begins the names of what gradient steps change
_LANES = "lanes."  # likewise, of what decides how the lanes continue
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
_ROLLOUT = ("_last_obs", "_last_episode_starts")
_UNSCALED = "_last_original_obs"  # before it was normalised
_EXPLORATION = ("exploration_mat", "exploration_matrices")
_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_MALFORMED = (KeyError, TypeError, ValueError, RuntimeError, IndexError, AttributeError)


class StoppedError(Exception):
    """A run stopped on request, its checkpoint written; `train` resumes it.

    Attributes:
        step: the training step at which it stopped.
    """

    def __init__(self, step: int):
        super().__init__(f"stopped after {step:,} steps")
        self.step = step


class Snapshot(NamedTuple):
    """Everything that decides how an agent's training continues."""

    tensors: Tensors
    counters: dict[str, Any]  # plain JSON


class Checkpointer(BaseCallback):
    """Resumes an agent from the run's checkpoint, if there is one, and saves it from time to time.

    It acts between rollouts, where an agent's state is complete, and comes after the callbacks
    that add to the history.

    Args:
        path: the checkpoint.
        identity: settings and versions as plain JSON, which must be equal for a run to resume.
        history: saved with the agent, and continued from the checkpoint.
        save_every: seconds between checkpoints.
        stop: whether to save and stop now.

    Raises:
        InputError: the checkpoint is damaged, or of other settings or versions.
        StoppedError: (in training) `stop` said so.
    """

    def __init__(
        self,
        path: Path,
        identity: Mapping[str, Any],
        history: History,
        save_every: float,
        stop: Callable[[], bool],
    ):
        super().__init__()
        self._path, self._identity, self._history = path, identity, history
        self._save_every, self._stop = save_every, stop
        self._snapshot = self._read() if exists(path) else None
        self._draws: Tensors = {}  # of the snapshot, until the first rollout
        self._saved = time.monotonic()

    def _on_training_start(self) -> None:
        if self._snapshot:
            self._draws = self._snapshot.tensors
            try:
                restore(self.model, self._snapshot)
            except EnvironmentFailedError as error:
                raise InputError(f"{self._path} can't be resumed: {error}") from None
            except InputError:
                raise
            except _MALFORMED:
                raise self._damaged() from None
            self._snapshot = None  # a replay buffer can be large

    def _on_rollout_start(self) -> None:
        if self._draws:  # state-dependent noise has just been drawn, for the second time
            _restore_draws(self.model, self._draws)
            self._draws = {}
        stopping = self._stop()
        if stopping or time.monotonic() - self._saved >= self._save_every:
            self._write()
            self._saved = time.monotonic()
        if stopping:
            raise StoppedError(self.model.num_timesteps)

    def _on_step(self) -> bool:
        return True

    def _read(self) -> Snapshot:
        tensors, header = container.read(self._path, "checkpoint", MAX_BYTES)
        try:
            objection = self._objection(dict(header["identity"]))
            if not objection:
                counters = dict(header["counters"])
                self._history.resume(header["record"], int(counters["num_timesteps"]))
                return Snapshot(tensors, counters)
        except _MALFORMED:
            raise self._damaged() from None
        raise InputError(
            f"{self._path} {objection}; choose another folder, or delete the file to start over"
        )

    def _objection(self, identity: Mapping[str, Any]) -> str:
        """Why a checkpoint of that identity isn't this run's; empty if it is."""
        if "environment" not in identity:
            return "was written by an earlier jbrep, which seeded episodes differently"
        others = differing(completed(identity), self._identity)
        return f"belongs to another configuration: {others}" if others else ""

    def _write(self) -> None:
        tensors, counters = take(self.model)
        header = {
            "identity": self._identity,
            "record": self._history.as_json(),
            "counters": counters,
        }
        container.write(self._path, tensors, header)

    def _damaged(self) -> DamageError:
        return DamageError(f"{self._path} is damaged: delete it to start over")


def take(agent: BaseAlgorithm) -> Snapshot:
    """Take a snapshot of an agent between two rollouts; its tensors share the agent's memory."""
    monitor, env = _envs(agent)
    kind, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - SB3 draws there
    tensors = {f"{PARAMETERS}{name}": tensor.numpy() for name, tensor in _parameters(agent)}
    tensors |= {f"{_LANES}{name}": values for name, values in env.state.items()}
    tensors |= {f"noise.{i}": n.noise_prev for i, n in enumerate(_drifting_noises(agent))}
    tensors |= {f"rollout.{name}": getattr(agent, name) for name in _ROLLOUT}
    if statistics := statistics_of(agent):
        tensors |= {**statistics.tensors, _UNSCALED: getattr(agent, _UNSCALED)}
    tensors |= {"returns": monitor.episode_returns, "lengths": monitor.episode_lengths}
    tensors |= {"torch": torch.get_rng_state().numpy(), "numpy": np.asarray(keys)}
    if noise := _state_dependent_noise(agent):
        tensors |= {name: getattr(noise, name).detach().numpy() for name in _EXPLORATION}
    counters = {name: getattr(agent, name) for name in _COUNTERS}
    counters |= {
        "numpy": (kind, position, has_gauss, gauss),
        "action_space": agent.action_space.np_random.bit_generator.state,
        "episodes": [{k: float(v) for k, v in e.items()} for e in agent.ep_info_buffer or ()],
    }
    if buffer := _buffer(agent):
        counters["buffer"] = (buffer.pos, buffer.full)
        tensors |= {f"buffer.{name}": values for name, values in _transitions(buffer).items()}
    return Snapshot(tensors, counters)


def restore(agent: BaseAlgorithm, snapshot: Snapshot) -> None:
    """Bring an agent that is set up to learn to where the snapshot was taken."""
    tensors, counters = snapshot
    monitor, env = _envs(agent)
    if buffer := _buffer(agent):
        buffer.pos, buffer.full = counters["buffer"]
        for name, values in _transitions(buffer).items():
            values[:] = tensors[f"buffer.{name}"]
    with torch.no_grad():
        for name, tensor in _parameters(agent):
            tensor.copy_(torch.from_numpy(tensors[f"{PARAMETERS}{name}"]))
    for i, noise in enumerate(_drifting_noises(agent)):
        noise.noise_prev = tensors[f"noise.{i}"]
    for name in _ROLLOUT:
        setattr(agent, name, tensors[f"rollout.{name}"])
    if normalizer := agent.get_vec_normalize_env():
        (size,) = agent.observation_space.shape or ()
        Statistics.read(tensors, size, "the checkpoint").give(normalizer)
        setattr(agent, _UNSCALED, tensors[_UNSCALED])
    for name in _COUNTERS:
        setattr(agent, name, counters[name])
    agent._num_timesteps_at_start = agent.num_timesteps  # of the rate that TensorBoard shows
    monitor.episode_returns, monitor.episode_lengths = tensors["returns"], tensors["lengths"]
    env.restore(
        {
            name.removeprefix(_LANES): values
            for name, values in tensors.items()
            if name.startswith(_LANES)
        }
    )
    assert agent.ep_info_buffer is not None
    agent.ep_info_buffer.extend(counters["episodes"])
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
    distribution = getattr(getattr(agent, "actor", agent.policy), "action_dist", None)
    is_one = isinstance(distribution, StateDependentNoiseDistribution)
    return distribution if is_one else None


def _envs(agent: BaseAlgorithm) -> tuple[VecMonitor, TaskVecEnv]:
    normalizer = agent.get_vec_normalize_env()
    monitor = normalizer.venv if normalizer else agent.env
    assert isinstance(monitor, VecMonitor)
    env = monitor.unwrapped
    assert isinstance(env, TaskVecEnv)
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


def _parameters(agent: BaseAlgorithm) -> Iterator[tuple[str, torch.Tensor]]:
    """Everything that gradient steps change: weights, targets, Adam's moments, entropy's weight."""
    _, variables = agent._get_torch_save_params()
    yield from ((name, getattr(agent, name).data) for name in variables)
    for name, part in trained_parts(agent):
        if isinstance(part, torch.optim.Optimizer):
            yield from _moments(name, part)
        else:
            yield from ((f"{name}.{key}", t) for key, t in part.state_dict().items())


def _moments(name: str, optimizer: torch.optim.Optimizer) -> Iterator[tuple[str, torch.Tensor]]:
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    for i, parameter in enumerate(parameters):
        for key, tensor in optimizer.state[parameter].items():
            yield f"{name}.{i}.{key}", tensor
