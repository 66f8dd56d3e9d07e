"""A run in a cohort: what is its own."""

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import Tensor

from jbrep.encoders.base import Float32
from jbrep.encoders.vec_env import agent_spaces
from jbrep.envs.lanes import EnvironmentFailedError, Flags, NonFiniteActionError
from jbrep.envs.task import Array
from jbrep.records.container import Tensors, without
from jbrep.rl import checkpoint
from jbrep.rl.agent import Spaces, make_agent
from jbrep.rl.checkpoint import ACTIONS_NOT_FINITE, WEIGHTS_NOT_FINITE, DivergedError, Snapshot
from jbrep.rl.files import Episode
from jbrep.rl.job import Job
from jbrep.rl.noise import Memory, Noise, beginning
from jbrep.rl.normalization import normalized
from jbrep.rl.overrides import without_buffer
from jbrep.rl.presets import argument

Indices = NDArray[np.int64]
_LOG_EVERY = 4  # episodes, as in stable-baselines3
_NOISE = "noise."  # begins the names of what lanes remember of it
_RANDOM = "random."  # begins the names of what its random numbers come from


class Member:
    """A run in a cohort.

    Its agent is one of stable-baselines3, made as if it were to learn alone: what it begins with,
    and what is evaluated and kept of it, are that agent's.

    Args:
        job: the run and its folder.
        writers: that get what TensorBoard gets.

    Attributes:
        agent: without a replay buffer.
        random: its random numbers.
        failed: why; None while it hasn't.
    """

    def __init__(self, job: Job, writers: Sequence[KVWriter]):
        run, settings, chosen = job.run, job.settings, job.settings.hyperparameters
        small = without_buffer(settings.algorithm, chosen.replace(noise=None))
        self.job = job
        self.failed: Exception | None = None
        env = DummyVecEnv([lambda: Spaces(*agent_spaces(run.task, job.encoder))])
        normalizing = normalized(env) if chosen.normalize else env
        self.agent: Any = make_agent(settings.algorithm, small, normalizing, run.seed)
        size = argument(settings.algorithm, chosen, "buffer_size")
        vars(self.agent)["buffer_size"] = size  # of policy.zip, which others may go on with
        self._normalizer: VecNormalize | None = self.agent.get_vec_normalize_env()
        steps = settings.episode_steps
        self.random = Random(self.agent.action_space, chosen.num_envs, chosen.noise, steps)
        self.agent._total_timesteps = settings.agent_steps
        self.agent.ep_info_buffer = deque(maxlen=self.agent._stats_window_size)
        self.agent.ep_success_buffer = deque()
        self.agent.start_time = time.time_ns()
        self._returns = np.zeros(chosen.num_envs, np.float32)
        self._lengths = np.zeros(chosen.num_envs, np.int32)
        job.prepare(self.agent, writers)

    @property
    def size(self) -> int:
        """Numbers in an encoded observation."""
        return self.job.encoder.latent_size

    def encode(self, observation: Array) -> Float32:
        """Observations of its lanes as its encoder shows them, (lanes, l)."""
        return self.job.encoder.encode(observation.astype(np.float32))

    def update_statistics(self, observation: Float32) -> None:
        """Take encoded observations into the statistics that normalise, if any do."""
        if self._normalizer:
            self._normalizer.obs_rms.update(observation)

    def normalize(self, observation: Float32) -> Float32:
        """Encoded observations as its agent sees them."""
        if not self._normalizer:
            return observation
        return np.asarray(self._normalizer.normalize_obs(observation))

    def record(
        self, reward: Float32, length: NDArray[np.int64], ended: Flags, diverged: Flags
    ) -> None:
        """Record a step of its lanes, (lanes,) each, and log every few episodes.

        Lengths are those of episodes so far in control steps.
        """
        agent, before = self.agent, self.agent._episode_num // _LOG_EVERY
        agent.num_timesteps += len(reward)
        self._returns += reward
        self._lengths += 1
        for lane in np.flatnonzero(ended).tolist():
            total, step = float(self._returns[lane]), self.job.step_of(agent)
            row = Episode(step, lane, total, int(length[lane]), bool(diverged[lane]))
            self.job.history.episodes.append(row)
            agent.ep_info_buffer.append({"r": total, "l": int(self._lengths[lane])})
            agent._episode_num += 1
            self._returns[lane] = self._lengths[lane] = 0
            self.random.reset_noise(lane)
        if agent._episode_num // _LOG_EVERY > before:
            agent.dump_logs()

    def log_losses(self, losses: Mapping[str, float], weights: float) -> None:
        """Log the losses of its last gradient steps, and let it fail where one isn't finite.

        Args:
            losses: by stable-baselines3's names.
            weights: the sum of its actor's, which isn't finite if one of them isn't.
        """
        for name, value in losses.items():
            self.agent.logger.record(f"train/{name}", value)
            if not math.isfinite(value):
                self.fail(DivergedError(f"train/{name} is {value}"))
        if not math.isfinite(weights):
            self.fail(DivergedError(WEIGHTS_NOT_FINITE))

    def evaluate(self, evaluation: Callable[[Job, BaseAlgorithm], None]) -> None:
        """Let an evaluation of its job's play its agent's policy."""
        try:
            evaluation(self.job, self.agent)
        except NonFiniteActionError:
            self.fail(DivergedError(ACTIONS_NOT_FINITE))
        except EnvironmentFailedError as error:
            self.fail(error)

    def fail(self, reason: Exception) -> None:
        """Note why it can't go on; the first reason is kept."""
        self.failed = self.failed or reason

    def take(self) -> Snapshot:
        """Everything of its own that decides how its training continues."""
        tensors, counters = checkpoint.take(self.agent)
        random, states = self.random.state
        tensors |= {f"{_RANDOM}{name}": values for name, values in random.items()}
        tensors |= {"returns": self._returns, "lengths": self._lengths}
        return Snapshot(tensors, {**counters, **states})

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from where a snapshot was taken."""
        checkpoint.restore(self.agent, snapshot)
        tensors, counters = snapshot
        self.random.restore(without(_RANDOM, tensors), counters)
        self._returns, self._lengths = tensors["returns"].copy(), tensors["lengths"].copy()


class Random:
    """A run's random numbers, from generators of its own, drawn in stable-baselines3's order.

    The generators begin as they are in this process just after the run's agent was made.

    Args:
        actions: the agent's space of actions, from which random ones are drawn.
        lanes: of the run.
        noise: on actions.
        steps: of the longest episode.
    """

    def __init__(self, actions: spaces.Space[Any], lanes: int, noise: Noise | None, steps: int):
        self._actions, self._lanes, self._noise = actions, lanes, noise
        self._numpy = np.random.RandomState()
        self._numpy.set_state(np.random.get_state())  # noqa: NPY002 - stable-baselines3 seeded it
        self._torch = torch.Generator()
        self._torch.set_state(torch.get_rng_state())
        (self._size,) = actions.shape or ()
        self._steps = steps
        self._memory: Memory = beginning(lanes, self._size)

    def actions(self) -> Float32:
        """Uniformly distributed ones, (lanes, k)."""
        return np.array([self._actions.sample() for _ in range(self._lanes)])

    def noise(self) -> Float32:
        """Noise on actions that are scaled to [-1, 1], (lanes, k)."""
        if self._noise:
            self._memory = self._noise.after(self._memory, self._steps, self._numpy)
        return np.array([each[0] for each in self._memory], np.float32)

    def reset_noise(self, lane: int) -> None:
        """Let a lane's noise start as in its first episode."""
        (self._memory[lane],) = beginning(1, self._size)

    def sample_indices(self, filled: int, size: int) -> tuple[Indices, Indices]:
        """The steps and lanes of a batch from a replay buffer with so many steps, (size,) each."""
        steps = self._numpy.randint(0, filled, size=size)
        return steps, self._numpy.randint(0, high=self._lanes, size=size)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers."""
        return torch.empty(shape).normal_(generator=self._torch)

    @property
    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """What `restore` takes: tensors, and plain JSON."""
        kind, keys, *rest = self._numpy.get_state()
        torchs, actions = self._torch.get_state(), self._actions.np_random.bit_generator.state
        tensors = {"numpy": np.asarray(keys), "torch": torchs.numpy()}
        tensors |= {f"{_NOISE}{lane}": each for lane, each in enumerate(self._memory)}
        return tensors, {"numpy": (kind, *rest), "actions": actions}

    def restore(self, tensors: Tensors, counters: Mapping[str, Any]) -> None:
        """Continue from a state."""
        kind, *rest = counters["numpy"]
        self._numpy.set_state((kind, tensors["numpy"], *rest))
        self._torch.set_state(torch.from_numpy(tensors["torch"]))
        self._memory = [tensors[f"{_NOISE}{lane}"] for lane in range(self._lanes)]
        self._actions.np_random.bit_generator.state = counters["actions"]
