"""Trained policies, read back."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from jbrep.encoders import find, load
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.code import make
from jbrep.encoders.encoder import as_file
from jbrep.envs.recording import Actor
from jbrep.envs.task import Array, Task
from jbrep.errors import DamageError, InputError, choose
from jbrep.records import container
from jbrep.records.record import from_plain
from jbrep.records.storage import exists
from jbrep.rl.agent import Spaces, deterministic, make_agent
from jbrep.rl.checkpoint import MAX_BYTES, PARAMETERS
from jbrep.rl.fields import MAX_STEPS, check_settings, completed, from_version_1, whole_number
from jbrep.rl.files import (
    BEGINNING,
    CHECKPOINT,
    ENCODER,
    POLICY,
    RUN,
    is_run,
    read_finished,
    read_run,
)
from jbrep.rl.normalization import Statistics
from jbrep.rl.overrides import check_shape, shaping
from jbrep.rl.presets import ALGORITHMS, Preset
from jbrep.rl.weights import fill, one_line, read_file, read_policy, statistics_in
from jbrep.training.trainer import single_torch_thread

_WEIGHTS = f"{PARAMETERS}policy."


class Trained(NamedTuple):
    """A policy, and what it acts on."""

    policy: BasePolicy
    task: Task
    encoder: BaseEncoder
    representation: str  # what the policy observes, as tables call it
    evaluation_episodes: int = 1  # that the run's evaluations play at once
    step: int | None = None  # of training, if it is not over
    settings: Mapping[str, Any] = {}  # of the run; none of a file from elsewhere
    statistics: Statistics | None = None  # by which it normalises what it sees, if it does

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        """Act deterministically; nothing is drawn.

        The actor raises an InputError for actions that are not finite.
        """
        act = deterministic(self.policy, self.encoder, self.task, self.statistics)

        def checked(observation: Array) -> NDArray[Any]:
            actions = act(observation)
            if not np.isfinite(actions).all():
                raise InputError("the policy's actions are not finite: it can't be played")
            return actions

        return checked

    def filled(
        self,
        weights: Mapping[str, torch.Tensor],
        tensors: Mapping[str, NDArray[Any]],
        source: Path,
    ) -> "Trained":
        """The policy with these weights, and with statistics from the tensors if it has any.

        Args:
            weights: by the names of the policy's parameters.
            tensors: with those of `Statistics` among them.
            source: the file that they come from, for messages.

        Raises:
            InputError: the weights don't fit the policy.
            DamageError: a number that it acts by isn't finite, or the statistics are missing.
        """
        fill(self.policy, weights, source)
        return self.with_statistics(tensors, source)

    def with_statistics(self, tensors: Mapping[str, NDArray[Any]], source: Path) -> "Trained":
        """The policy with the statistics in the tensors, if it has any.

        Raises:
            DamageError: they are missing or invalid.
        """
        if self.statistics is None:
            return self
        size = self.encoder.latent_size
        return self._replace(statistics=Statistics.read(tensors, size, source))


def load_run(folder: Path, encoder: Any = None) -> Trained:
    """The policy of a run; nothing that the folder holds is run as code.

    A finished run has its final policy, one that is under way or was stopped its checkpoint's. Only
    numbers are read of either; the network that they belong to is built from the run's settings.

    Args:
        folder: of the run.
        encoder: the one that the run was made with, where its folder has none because it is a
            user's own; whatever `jbrep.encoders.find` takes. Code whose module was imported on
            request is known without it.

    Raises:
        InputError: no run there, a failed one, one without a checkpoint so far, or one whose files
            are inconsistent.
        DamageError: a file isn't what was written.
    """
    if not is_run(folder):
        raise InputError(
            f"no run in {folder}: {RUN} or {CHECKPOINT} is expected, which a run writes about a "
            "minute after its start"
        )
    if not exists(folder / RUN):
        return _load_checkpoint(folder, encoder)
    run = read_finished(folder)
    path = folder / POLICY
    trained = _untrained(folder, run["settings"], encoder)
    return trained.filled(*read_policy(path, run["policy_sha256"]), path)


def load_untrained(folder: Path, encoder: Any = None) -> Trained:
    """The policy that a run began with.

    Raises:
        InputError: as `load_run`.
        DamageError: a file isn't what was written.
    """
    settings = run_settings(folder)
    trained = _untrained(folder, settings, encoder)
    if not settings["from"]:
        return trained
    path = folder / BEGINNING
    return trained.filled(*read_policy(path, settings["from"]), path)


def run_settings(folder: Path) -> dict[str, Any]:
    """The settings of a run that has ended or is under way.

    Raises:
        InputError: as `load_run`.
        DamageError: a file isn't what was written.
    """
    if exists(folder / RUN):
        return read_run(folder)["settings"]
    return _read_checkpoint(folder).settings


def load_zip(path: Path, task: Task, algorithm: str, encoder: str, trust: bool) -> Trained:
    """The policy of a stable-baselines3 zip file from elsewhere.

    Args:
        path: the file.
        task: which the policy was trained on.
        algorithm: a key of ALGORITHMS.
        encoder: what the policy was trained on: a file, or the name of one that ships.
        trust: whether the file may run code; without it nothing is read.

    Raises:
        InputError: it isn't trusted, is no such file, or fits neither task nor encoder.
    """
    if not trust:
        raise InputError(
            f"{path} is not in a folder of jbrep rl: stable-baselines3 files hold pickled Python, "
            "which runs as code when it is read; add --trust if you know who made it"
        )
    learner = choose(algorithm, ALGORITHMS, "algorithm")
    seen = find(encoder, task)
    raw = read_file(path.resolve())
    try:
        agent = learner.load(io.BytesIO(raw), Spaces(task, seen), device="cpu")
        tensors = statistics_in(raw)
    except Exception as error:  # whatever its pickled parts do
        reason = one_line(error)
        raise InputError(f"{path} is no {algorithm} policy for {task.name}: {reason}") from None
    statistics = Statistics.read(tensors, seen.latent_size, path) if tensors else None
    return Trained(agent.policy, task, seen, seen.name, statistics=statistics)


class _Checkpoint(NamedTuple):
    """What a run under way has kept of its policy."""

    settings: dict[str, Any]
    step: int
    weights: dict[str, torch.Tensor]
    tensors: container.Tensors


def _read_checkpoint(folder: Path) -> _Checkpoint:
    path = folder / CHECKPOINT
    tensors, header = container.read(path, "checkpoint", MAX_BYTES)
    settings, counters = header.get("identity"), header.get("counters")
    if not isinstance(settings, dict) or not isinstance(counters, dict):
        raise DamageError(f"{path} is not a run's checkpoint")
    if "environment" not in settings:
        settings = from_version_1(path, settings)
    settings = completed(settings)
    check_settings(path, settings)
    step = counters.get("num_timesteps", -1)
    if not whole_number(0, MAX_STEPS).allows(step):
        raise DamageError(f"{path} is damaged: its number of steps is {step!r}")
    weights = {
        name.removeprefix(_WEIGHTS): torch.tensor(values)
        for name, values in tensors.items()
        if name.startswith(_WEIGHTS) and not name.startswith(f"{_WEIGHTS}optimizer.")
    }
    return _Checkpoint(settings, step, weights, tensors)


def _load_checkpoint(folder: Path, encoder: Any) -> Trained:
    checkpoint = _read_checkpoint(folder)
    trained = _untrained(folder, checkpoint.settings, encoder)._replace(step=checkpoint.step)
    return trained.filled(checkpoint.weights, checkpoint.tensors, folder / CHECKPOINT)


def _untrained(folder: Path, settings: Mapping[str, Any], given: Any) -> Trained:
    """What a run trains, as it begins unless another run's policy comes along."""
    task = from_plain(settings["environment"], Task)
    with single_torch_thread():  # as in training, so that a module computes the same bits
        encoder = run_encoder(folder, settings) if given is None else as_file(find(given, task))
    return build(folder, settings, encoder)


def build(path: Path, settings: Mapping[str, Any], encoder: BaseEncoder) -> Trained:
    """The untrained policy of a run; `Trained.filled` gives it weights.

    Args:
        path: where the settings are from, for messages.
        settings: of the run, as run.json has them, checked by `check_settings`.
        encoder: of the run.

    Raises:
        InputError: the settings can't be those of a run, or the encoder isn't the run's.
    """
    task, algorithm = from_plain(settings["environment"], Task), settings["algorithm"]
    choose(algorithm, ALGORITHMS, "algorithm")
    if encoder.fingerprint != settings["encoder"]:
        raise InputError(f"{encoder.name} is not the encoder that the run in {path} was made with")
    check_shape(algorithm, settings["hidden"], settings["policy"])
    encoder.check_task(task)
    preset = Preset(settings["hidden"], shaping(settings["settings"]), policy=settings["policy"])
    try:
        agent = make_agent(algorithm, preset, Spaces(task, encoder), settings["seed"])
    except (AssertionError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"no policy can be made from the settings of the run: {one_line(error)}"
        ) from None
    statistics = Statistics.untrained(encoder.latent_size) if settings["normalize"] else None
    name, episodes = settings["representation"], settings["evaluation_episodes"]
    return Trained(
        agent.policy, task, encoder, name, episodes, settings=settings, statistics=statistics
    )


def run_encoder(folder: Path, settings: Mapping[str, Any]) -> BaseEncoder:
    """The encoder in a run's folder, or what its code makes.

    Raises:
        InputError: it is code whose module wasn't imported on request, or a user's own object, or
            it can't be used.
        DamageError: its file isn't what was written.
    """
    if exists(folder / ENCODER):
        return load(folder / ENCODER)
    if code := settings["encoder_code"]:
        return make(code, from_plain(settings["environment"], Task))
    raise InputError(
        f"no {ENCODER} in {folder}: a run on a Python object needs it again, as in "
        "load_run(folder, encoder)"
    )
