"""A run's checkpoint, and from where the run in a folder goes on.

A checkpoint holds everything that decides how training continues, in a file without code.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import (
    ActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)

from jbrep.encoders.vec_env import JitterbugVecEnv
from jbrep.envs.environments import EnvironmentFailedError
from jbrep.errors import InputError, differences
from jbrep.records import container
from jbrep.records.container import Tensors, without
from jbrep.records.document import Document, document_from
from jbrep.records.record import Version
from jbrep.records.storage import exists
from jbrep.rl.agent import ColouredActionNoise, parameters, restore_statistics, statistics_of
from jbrep.rl.files import CHECKPOINT, FAILED, RUN, Episode, Evaluation, Info, RunRecord, read_run
from jbrep.rl.history import History
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import MAX_STEPS

PARAMETERS = "parameters."  # begins the names of what gradient steps change
_ENVS, _BUFFER = "envs.", "buffer."  # likewise, of environments and of the replay buffer
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")  # of an agent
_MEMORIES: dict[type, str] = {  # of noises that depend on what was drawn before
    OrnsteinUhlenbeckActionNoise: "noise_prev",
    ColouredActionNoise: "ahead",
}
_UNSCALED = "_last_original_obs"  # before it was normalised
_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Header(Document, frozen=True, kw_only=True):
    """The header of a checkpoint."""

    format = "jbrep checkpoint"
    format_version = 5

    settings: RunSettings  # of the run
    # by package; these and the settings must be equal for the run to resume
    versions: Mapping[Version, Version]
    step: Annotated[int, Meta(ge=0, le=MAX_STEPS)]  # of training
    # episodes, evaluations, infos, seconds: of the history so far
    episodes: list[Episode]
    evaluations: list[Evaluation]
    infos: list[Info]
    seconds: float
    counters: Mapping[str, Any]  # of the agent and its random numbers, as plain JSON

    @property
    def history(self) -> History:
        """What the run had recorded by then."""
        return History(
            self.episodes, self.evaluations, self.infos, self.seconds, first_step=self.step
        )


class Checkpoint(NamedTuple):
    """What a run's checkpoint holds."""

    path: Path
    header: Header
    tensors: Tensors

    @classmethod
    def read(cls, folder: Path) -> "Checkpoint":
        """The one in a run's folder."""
        path = folder / CHECKPOINT
        tensors, header = container.read(path, "checkpoint")
        return cls(path, document_from(header, path, Header), tensors)

    def restore(self, agent: BaseAlgorithm) -> None:
        """Bring an agent that is set up to learn to where the checkpoint was taken."""
        try:
            _restore(agent, self.tensors, self.header.counters)
        except EnvironmentFailedError as error:
            raise InputError(f"{self.path} can't be resumed: {error}") from None


def read_header(folder: Path) -> Header | None:
    """The header of a run's checkpoint, without the rest, which can be large; None without one."""
    path = folder / CHECKPOINT
    return document_from(container.peek(path), path, Header) if exists(path) else None


class Standing(NamedTuple):
    """How far a run has come in its folder."""

    # of the run, with the warm-up of before, and evaluations as far apart where that is left open
    settings: RunSettings
    # the contents of run.json, if the run has ended; it may have gone on from fewer steps
    ended: RunRecord | None = None
    resumes: bool = False  # whether it goes on from its checkpoint


def standing(
    folder: Path, wanted: RunSettings, versions: Mapping[str, str], is_open: bool = False
) -> Standing:
    """How far a run has come in a folder, which is new, or this run's.

    A run of fewer steps goes on from its checkpoint; one that was stopped resumes from it. Both
    need the versions that it began with, an environment that can be reproduced, and, to go on, a
    run that has not failed and settings that don't depend on the number of steps.

    Args:
        folder: of the run; it need not exist.
        wanted: settings of the run.
        versions: of the packages that decide its numbers.
        is_open: whether the run leaves open how far apart evaluations are.
    """
    record = read_run(folder) if exists(folder / RUN) else None
    header = None if record and not record.settings.differing(wanted) else read_header(folder)
    latest = header or record
    if latest is None:
        return Standing(wanted)
    before = record.settings if record else latest.settings
    same = wanted.beginning_as(before)
    if is_open:
        same = same.replace(evaluate_every=before.evaluate_every)
    if before.is_extended_by(same) or not before.differing(same):
        wanted = same
    if record and not record.settings.differing(wanted):
        return Standing(wanted, ended=record)
    is_longer = latest.settings.is_extended_by(wanted)
    if not is_longer and (others := latest.settings.differing(wanted)):
        raise InputError(f"{folder} holds another run: {others}; choose another folder")
    if reason := _obstacle(record, latest.settings, wanted, is_longer):
        raise InputError(f"the run in {folder} can't go on: {reason}; choose another folder")
    if header is None:
        raise InputError(
            f"the run in {folder} can't go on: {CHECKPOINT} is missing; choose another folder, "
            "perhaps beginning with its policy, `begin_from`"
        )
    if others := differences(header.versions, versions):
        raise InputError(
            f"the run in {folder} can't go on with other versions: {others}; install those, or "
            "choose another folder"
        )
    return Standing(wanted, resumes=True)


def _obstacle(
    record: RunRecord | None, before: RunSettings, wanted: RunSettings, is_longer: bool
) -> str:
    """Why a run can't go on; empty if it can."""
    if record and record.status == FAILED:
        return "it failed"
    if is_longer and before.schedules:
        return f"its {before.schedules[0]} fell to 0 over {before.steps:,} steps"
    if not wanted.environment.reproducible:
        return (
            f"{wanted.task} is not reproducible (its policy can be played and exported: see jbrep "
            "evaluate-policy)"
        )
    return ""


class Saver:
    """Writes a run's checkpoints, the last one alone.

    There are so many seconds between them, more where writing one takes over two seconds.
    """

    def __init__(
        self, folder: Path, settings: RunSettings, versions: Mapping[str, str], every: float
    ):
        self._path, self._settings, self._versions = folder / CHECKPOINT, settings, versions
        self._every, self._saved, self._took = every, time.monotonic(), 0.0

    @property
    def is_due(self) -> bool:
        """Whether to write the next one."""
        return time.monotonic() - self._saved >= self._every * max(1.0, self._took / 2)

    def write(self, agent: BaseAlgorithm, history: History) -> None:
        """Replace the last one."""
        begun = time.monotonic()
        tensors, counters = _take(agent)
        header = Header(
            settings=self._settings,
            versions=self._versions,
            step=self._settings.control_steps(agent.num_timesteps),
            episodes=history.episodes,
            evaluations=history.evaluations,
            infos=history.infos,
            seconds=history.seconds,
            counters=counters,
        )
        container.write(self._path, tensors, header.as_json())
        self._saved = time.monotonic()
        self._took = self._saved - begun


def _take(agent: BaseAlgorithm) -> tuple[Tensors, dict[str, Any]]:
    """What an agent between two rollouts continues from; tensors share its memory."""
    tensors = {f"{PARAMETERS}{name}": t.numpy(force=True) for name, t in parameters(agent)}
    if statistics := statistics_of(agent):
        tensors |= statistics.tensors
    tensors |= {f"{_ENVS}{name}": values for name, values in vec_env(agent).state.items()}
    tensors |= {name: getattr(*place) for name, place in _arrays(agent).items()}
    kind, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - SB3 draws there
    tensors |= {"torch": torch.get_rng_state().numpy(), "numpy": np.asarray(keys)}
    if agent.device.type == "cuda":
        tensors["cuda"] = torch.cuda.get_rng_state().numpy()
    counters: dict[str, Any] = {name: getattr(agent, name) for name in _COUNTERS}
    counters |= {
        "numpy": (kind, position, has_gauss, gauss),
        "action_space": agent.action_space.np_random.bit_generator.state,
        "episodes": [{k: float(v) for k, v in e.items()} for e in agent.ep_info_buffer or ()],
    }
    if buffer := _buffer(agent):
        counters["buffer"] = (buffer.pos, buffer.full)
        tensors |= {f"{_BUFFER}{name}": values for name, values in _filled(buffer).items()}
    return tensors, counters


def _restore(agent: BaseAlgorithm, tensors: Tensors, counters: Mapping[str, Any]) -> None:
    with torch.no_grad():
        for name, tensor in parameters(agent):
            tensor.copy_(torch.from_numpy(tensors[f"{PARAMETERS}{name}"]))
    restore_statistics(agent, tensors)
    for name in _COUNTERS:
        setattr(agent, name, int(counters[name]))
    agent._num_timesteps_at_start = agent.num_timesteps  # of the rate that TensorBoard shows
    agent.start_time = time.time_ns()
    assert agent.ep_info_buffer is not None
    agent.ep_info_buffer.clear()
    agent.ep_info_buffer.extend(counters["episodes"])
    if buffer := _buffer(agent):
        buffer.pos, buffer.full = counters["buffer"]
        for name, values in _filled(buffer).items():
            values[:] = tensors[f"{_BUFFER}{name}"]
    for name, place in _arrays(agent).items():
        setattr(*place, tensors[name])
    vec_env(agent).restore(without(_ENVS, tensors))
    agent.action_space.np_random.bit_generator.state = counters["action_space"]
    torch.set_rng_state(torch.from_numpy(tensors["torch"]))
    if agent.device.type == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(tensors["cuda"]))
    kind, *rest = counters["numpy"]
    np.random.set_state((kind, tensors["numpy"], *rest))  # noqa: NPY002


def _arrays(agent: BaseAlgorithm) -> dict[str, tuple[object, str]]:
    """Which arrays decide how a rollout goes on: the object that has each, and its attribute."""
    normalizer = agent.get_vec_normalize_env()
    monitor = normalizer.venv if normalizer else agent.env
    last = ("_last_obs", "_last_episode_starts")
    places: dict[str, tuple[object, str]] = {f"rollout.{name}": (agent, name) for name in last}
    if normalizer:
        places[_UNSCALED] = agent, _UNSCALED
    for i, noise in enumerate(_noises(agent)):
        if memory := _MEMORIES.get(type(noise)):
            places[f"noise.{i}"] = noise, memory
    return places | {
        "returns": (monitor, "episode_returns"),
        "lengths": (monitor, "episode_lengths"),
    }


def vec_env(agent: BaseAlgorithm) -> JitterbugVecEnv:
    """The environments that an agent is trained in."""
    env = agent.env.unwrapped if agent.env else None
    assert isinstance(env, JitterbugVecEnv)
    return env


def _buffer(agent: BaseAlgorithm) -> ReplayBuffer | None:
    return getattr(agent, "replay_buffer", None)


def _filled(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    size = buffer.buffer_size if buffer.full else buffer.pos
    return {name: getattr(buffer, name)[:size] for name in _TRANSITIONS}


def _noises(agent: BaseAlgorithm) -> Sequence[ActionNoise]:
    noise = getattr(agent, "action_noise", None)
    return noise.noises if isinstance(noise, VectorizedActionNoise) else [noise] if noise else []
