"""policy.safetensors: a trained policy, its encoder and all settings of its run, in a safe file.

Reading one runs nothing in it. A run's own also has what only training needs, critics and targets,
so that another run can begin with it; copies leave that out.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.file import unpack as unpack_encoder
from jbrep.envs.recording import Actor, held
from jbrep.envs.task import Array, Task
from jbrep.errors import DamageError, InputError
from jbrep.records import container
from jbrep.records.container import Tensors
from jbrep.records.document import document_from
from jbrep.records.storage import read_file, write_whole
from jbrep.rl.agent import Spaces, deterministic, make_agent, one_line, seeing
from jbrep.rl.checkpoint import without
from jbrep.rl.files import PolicyHeader, RunSettings
from jbrep.rl.normalization import Statistics
from jbrep.rl.overrides import check_shape

MAX_BYTES = 1 << 28
_ACTING, _TRAINING, _ENCODER = "policy.", "training.", "encoder."  # before the names of tensors


class Trained(NamedTuple):
    """A policy, and what it acts on."""

    policy: BasePolicy
    task: Task
    encoder: BaseEncoder
    settings: RunSettings | None = None  # none of a file from elsewhere
    step: int | None = None  # of training, if it is not over
    statistics: Statistics | None = None  # by which it normalises what it sees, if it does
    action_repeat: int = 1  # control steps for which each of its actions is held

    @property
    def representation(self) -> str:
        """What the policy observes, as tables call it."""
        return self.settings.representation if self.settings else str(self.encoder.name)

    @property
    def evaluation_episodes(self) -> int:
        """That the run's evaluations play at once."""
        return self.settings.evaluation_episodes if self.settings else 1

    def begin(self, task: Task, seeds: Any) -> Actor:
        """Act deterministically in episodes that begin now; nothing is drawn.

        The actor raises an InputError for actions that are not finite.
        """
        see = seeing(self.encoder.encode, self.statistics)
        return self._held(deterministic(self.policy, self.task, see))

    def one_by_one(self) -> Actor:
        """The same with an encoder in torch, in one episode at a time."""
        encode = self.encoder.encode
        see = seeing(lambda row: encode(torch.from_numpy(row)).numpy(), self.statistics)
        return self._held(deterministic(self.policy, self.task, see, batch_size=1))

    def _held(self, act: Actor) -> Actor:
        return held(_finite(act), self.action_repeat)

    def with_weights(self, weights: Tensors, tensors: Tensors, source: Path) -> "Trained":
        """The policy with weights of the part that acts, and with statistics from a file's tensors.

        Raises:
            InputError: the weights don't fit the policy.
            DamageError: a number that it acts by isn't finite, or the statistics are missing.
        """
        fill(acting(self.policy), weights, source)
        if self.statistics is None:
            return self
        size = self.encoder.latent_size
        return self._replace(statistics=Statistics.read(tensors, size, source))


def _finite(act: Actor) -> Actor:
    def checked(observation: Array) -> NDArray[Any]:
        actions = act(observation)
        if not np.isfinite(actions).all():
            raise InputError("the policy's actions are not finite: it can't be played")
        return actions

    return checked


def acting(policy: BasePolicy) -> BasePolicy:
    """The part of a policy that chooses actions: without critics where they are apart."""
    return getattr(policy, "actor", policy)


def fill(policy: BasePolicy, weights: Tensors, path: Path) -> None:
    """Put weights, by their names, into a policy or its acting part: all it has, and no others.

    Raises:
        InputError: they don't fit the policy.
        DamageError: a weight that the policy acts by is not finite.
    """
    try:
        policy.load_state_dict({name: torch.tensor(values) for name, values in weights.items()})
    except (AttributeError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{path} doesn't fit the run's settings: {one_line(error)}") from None
    if not all(bool(torch.isfinite(part).all()) for part in acting(policy).parameters()):
        raise DamageError(f"{path} is damaged: the policy's weights are not finite")


def build(settings: RunSettings, encoder: BaseEncoder, path: Path) -> Trained:
    """The untrained policy of a run, whose settings are from that path.

    Raises:
        InputError: the settings can't be those of a run, or the encoder isn't the run's.
    """
    task = settings.environment
    if encoder.fingerprint != settings.encoder:
        raise InputError(f"{encoder.name} is not the encoder that the run in {path} was made with")
    encoder.check_task(task)
    shape = check_shape(settings.algorithm, settings.hyperparameters)
    try:
        agent = make_agent(settings.algorithm, shape, Spaces(task, encoder), settings.seed)
    except (AssertionError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"no policy can be made from the settings of the run: {one_line(error)}"
        ) from None
    statistics = Statistics.untrained(encoder.latent_size) if shape.normalize else None
    repeat = settings.hyperparameters.action_repeat
    return Trained(agent.policy, task, encoder, settings, None, statistics, repeat)


def pack(trained: Trained, run: str) -> bytes:
    """The bytes of a policy's file, to act with alone; `run` is what its run is called, a line.

    Raises:
        InputError: its encoder is code, which no file can hold.
    """
    if not isinstance(trained.encoder, Encoder):
        raise InputError(
            f"the policy of {run} can't be kept in a file: its encoder, {trained.encoder.name}, is "
            "code"
        )
    return _pack(trained, run, {})


def pack_whole(trained: Trained) -> bytes:
    """The bytes of the policy's file in a run's folder, with all that a run can begin with."""
    assert trained.settings is not None
    parts = {} if acting(trained.policy) is trained.policy else trained.policy.state_dict()
    others = {name: each for name, each in parts.items() if not name.startswith("actor.")}
    return _pack(trained, trained.settings.name, _named(_TRAINING, others))


def _pack(trained: Trained, run: str, tensors: Tensors) -> bytes:
    settings, encoder = trained.settings, trained.encoder
    assert settings is not None
    header = PolicyHeader(
        settings=settings,
        encoder=encoder.header.as_json() if isinstance(encoder, Encoder) else None,
        run=run,
        step=settings.steps if trained.step is None else trained.step,
        finished=trained.step is None,
    )
    tensors |= _named(_ACTING, acting(trained.policy).state_dict())
    if isinstance(encoder, Encoder):
        tensors |= {f"{_ENCODER}{name}": values for name, values in encoder.tensors().items()}
    if trained.statistics is not None:
        tensors |= trained.statistics.tensors
    return container.pack(tensors, header.as_json())


def _named(prefix: str, weights: Mapping[str, torch.Tensor]) -> Tensors:
    return {f"{prefix}{name}": each.numpy(force=True) for name, each in weights.items()}


def save(trained: Trained, path: Path, run: str) -> None:
    """Write a policy's file, to act with alone, whole or not at all.

    Raises:
        InputError: as `pack`, or it can't be written.
    """
    write_whole(path, pack(trained, run))


class PolicyFile(NamedTuple):
    """What a policy's file has."""

    header: PolicyHeader
    tensors: Tensors
    path: Path

    @property
    def weights(self) -> Tensors:
        """Of the part that acts, by the names of its parameters."""
        return without(_ACTING, self.tensors)

    def fill_whole(self, policy: BasePolicy) -> None:
        """As `fill`, with the weights that only training needs, too, which a run's own file has."""
        prefix = "" if acting(policy) is policy else "actor."
        acts = {f"{prefix}{name}": values for name, values in self.weights.items()}
        fill(policy, acts | without(_TRAINING, self.tensors), self.path)

    def encoder(self) -> Encoder:
        """The encoder in it.

        Raises:
            InputError: there is none, as it is code.
            DamageError: it isn't that of the settings.
        """
        settings = self.header.settings
        if self.header.encoder is None:
            raise InputError(f"{self.path} has no encoder: that of its run is code")
        encoder = unpack_encoder(self.path, without(_ENCODER, self.tensors), self.header.encoder)
        if encoder.fingerprint != settings.encoder:
            raise DamageError(f"{self.path} is damaged: its encoder isn't the one of its settings")
        return encoder

    def trained(self) -> Trained:
        """The policy with the encoder in the file.

        Raises:
            InputError, DamageError: it isn't what was written.
        """
        built = build(self.header.settings, self.encoder(), self.path)
        step = None if self.header.finished else self.header.step
        return built.with_weights(self.weights, self.tensors, self.path)._replace(step=step)


def read(path: Path, sha256: str = "") -> PolicyFile:
    """Read a policy's file, whose SHA-256 may be known.

    Raises:
        InputError: no such file, another kind of file, or another version of the format.
        DamageError: it isn't what was written, or the file with that hash.
    """
    raw = read_file(path, MAX_BYTES)
    if sha256 and hashlib.sha256(raw).hexdigest() != sha256:
        raise DamageError(f"{path} is damaged or another run's: its SHA-256 isn't in run.json")
    return unpack(raw, path)


def unpack(raw: bytes, path: Path) -> PolicyFile:
    """The same of a file's bytes; the path is for messages.

    Raises:
        InputError, DamageError: as `read`.
    """
    tensors, header = container.unpack(raw, path, "policy")
    return PolicyFile(document_from(header, path, PolicyHeader), tensors, path)
