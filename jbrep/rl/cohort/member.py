"""A run in a cohort: what is its own."""

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from jbrep.envs.lanes import EnvironmentFailedError, NonFiniteActionError
from jbrep.rl.agent import Evaluator, Spaces, make_agent, parameters
from jbrep.rl.beginning import begin
from jbrep.rl.checkpoint import COUNTERS, PARAMETERS, Snapshot, without
from jbrep.rl.cohort.draws import Draws
from jbrep.rl.files import Episode
from jbrep.rl.history import ACTIONS_NOT_FINITE, WEIGHTS_NOT_FINITE
from jbrep.rl.job import Job
from jbrep.rl.normalization import Statistics, normalized

Array = NDArray[np.float64]
Float32 = NDArray[np.float32]
Flags = NDArray[np.bool_]
_LOG_EVERY = 4  # episodes, as in stable-baselines3
_DRAWS = "draws."  # begins the names of what its random numbers come from


class Member:
    """A run in a cohort.

    Its agent is one of stable-baselines3, made as if it were to learn alone: what it begins with,
    and what is evaluated and kept of it, are that agent's.

    Args:
        job: the run and its folder.
        writers: that get what TensorBoard gets.

    Attributes:
        job: the run and its folder.
        agent: without a replay buffer.
        draws: its random numbers.
        failure: why it failed; empty while it hasn't.
    """

    def __init__(self, job: Job, writers: Sequence[KVWriter]):
        run, preset = job.run, job.run.used
        small = replace(preset, noise=None, settings={**preset.settings, "buffer_size": 1})
        self.job, self.failure = job, ""
        env = DummyVecEnv([lambda: Spaces(run.task, job.encoder)])
        shown = normalized(env) if preset.normalize else env
        self.agent: Any = make_agent(run.algorithm, small, shown, run.seed)
        self.draws = Draws(self.agent.action_space, preset.num_envs, preset.noise)
        self.agent._total_timesteps = run.steps
        self.agent.ep_info_buffer = deque(maxlen=self.agent._stats_window_size)
        self.agent.ep_success_buffer = deque()
        self.agent.start_time = time.time_ns()
        self._returns = np.zeros(preset.num_envs, np.float32)
        self._lengths = np.zeros(preset.num_envs, np.int32)
        self._evaluator = Evaluator(
            run.task, job.encoder, run.evaluation_episodes, num_threads=run.physics_threads
        )
        self.mean: float | None = None  # return of the last evaluation
        if run.begin_from:
            begin(self.agent, Path(run.begin_from), job.settings["from"], job.folder)
        self.agent.set_logger(job.logger(writers))

    @property
    def size(self) -> int:
        """Numbers in what it sees."""
        return self.job.encoder.latent_size

    def see(self, observation: Array) -> Float32:
        """Observations of its lanes as its encoder shows them, (lanes, l)."""
        return self.job.encoder.encode(observation.astype(np.float32))

    @property
    def normalizer(self) -> VecNormalize | None:
        """What normalises what it sees, if its preset says so."""
        return self.agent.get_vec_normalize_env()

    def record(self, reward: Float32, ended: Flags, diverged: Flags) -> bool:
        """Record a step of its lanes, (lanes,) each; whether it is time to log."""
        agent, before = self.agent, self.agent._episode_num // _LOG_EVERY
        agent.num_timesteps += len(reward)
        self._returns += reward
        self._lengths += 1
        for lane in np.flatnonzero(ended).tolist():
            total, length = float(self._returns[lane]), int(self._lengths[lane])
            row = Episode(agent.num_timesteps, lane, total, length, bool(diverged[lane]))
            self.job.history.episodes.append(row)
            agent.ep_info_buffer.append({"r": total, "l": length})
            agent._episode_num += 1
            self._returns[lane] = self._lengths[lane] = 0
            self.draws.episode_ended(lane)
        return agent._episode_num // _LOG_EVERY > before

    def take(self) -> Snapshot:
        """Everything of its own that decides how its training continues."""
        agent = self.agent
        tensors = {f"{PARAMETERS}{name}": each.numpy() for name, each in parameters(agent)}
        drawn, counters = self.draws.state
        tensors |= {f"{_DRAWS}{name}": values for name, values in drawn.items()}
        tensors |= {"returns": self._returns, "lengths": self._lengths}
        if self.normalizer:
            tensors |= Statistics.of(self.normalizer).tensors
        counters |= {name: getattr(agent, name) for name in COUNTERS}
        counters |= {"mean": self.mean, "episodes": list(agent.ep_info_buffer)}
        return Snapshot(tensors, counters)

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from where a snapshot was taken."""
        (tensors, counters), agent = snapshot, self.agent
        with torch.no_grad():
            for name, each in parameters(agent):
                each.copy_(torch.from_numpy(tensors[f"{PARAMETERS}{name}"]))
        self.draws.restore(without(_DRAWS, tensors), counters)
        self._returns, self._lengths = tensors["returns"].copy(), tensors["lengths"].copy()
        for name in COUNTERS:
            setattr(agent, name, counters[name])
        agent._num_timesteps_at_start = agent.num_timesteps  # of the rate that is logged
        agent.ep_info_buffer.extend(counters["episodes"])
        self.mean = counters["mean"]
        if self.normalizer:
            Statistics.read(tensors, self.size, "the checkpoint").give(self.normalizer)

    def learnt(self, losses: Mapping[str, float], weights: float) -> None:
        """Note the losses of its last gradient steps, and whether it has failed.

        Args:
            losses: by stable-baselines3's names.
            weights: the sum of its actor's, which isn't finite if one of them isn't.
        """
        for name, value in losses.items():
            self.agent.logger.record(f"train/{name}", value)
        told = {f"train/{name} is {value}": value for name, value in losses.items()}
        told[WEIGHTS_NOT_FINITE] = weights
        for words, value in told.items():
            if not math.isfinite(value):
                self.fail(words)

    def fail(self, reason: str) -> None:
        """Note why it can't go on; the first reason is kept."""
        self.failure = self.failure or reason

    def log(self) -> None:
        """Log its losses and what its last episodes returned."""
        self.agent.dump_logs()

    def evaluate(self) -> None:
        """Play its agent's policy, deterministically."""
        step = self.agent.num_timesteps
        try:
            episodes = self.job.run.episodes_at(step)
            returns = self._evaluator.returns(self.agent, episodes)
        except NonFiniteActionError:
            self.fail(ACTIONS_NOT_FINITE)
            return
        except EnvironmentFailedError as error:
            self.fail(str(error))
            return
        self.mean = self.job.history.evaluated(step, returns, self.agent.logger)
