"""Trained policies: what acts, on what, and as files that training or acting can go on with."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.vec_env import agent_spaces
from jbrep.envs.recording import Actor, held
from jbrep.envs.task import Array, Task
from jbrep.errors import DamageError, InputError, refusing
from jbrep.records import container
from jbrep.records.container import Tensors, without
from jbrep.rl.agent import (
    Spaces,
    acting,
    deterministic_actor,
    global_random_state_kept,
    make_agent,
    one_line,
    preprocessor,
)
from jbrep.rl.files import PolicyHeader
from jbrep.rl.normalization import Statistics
from jbrep.rl.overrides import check_shape, without_buffer
from jbrep.rl.policy_file import ACTING, ENCODER, TRAINING, PolicyFile
from jbrep.rl.run_settings import RunSettings


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
        preprocess = preprocessor(self.encoder.encode, self.statistics)
        return self._held(deterministic_actor(self.policy, self.task, preprocess))

    def one_by_one(self) -> Actor:
        """The same with an encoder in torch, in one episode at a time."""
        encode = self.encoder.encode
        preprocess = preprocessor(
            lambda row: np.asarray(encode(torch.from_numpy(row))), self.statistics
        )
        return self._held(deterministic_actor(self.policy, self.task, preprocess, batch_size=1))

    def _held(self, act: Actor) -> Actor:
        return held(_finite(act), self.action_repeat)

    def with_weights(self, weights: Tensors, tensors: Tensors, source: Path) -> "Trained":
        """The policy with weights of the part that acts, and with statistics from a file's tensors.

        Raises:
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


def acting_prefix(policy: BasePolicy) -> str:
    """What the names of a policy's weights begin with in the part that acts, if it is a part."""
    return "" if acting(policy) is policy else "actor."


def fill(policy: BasePolicy, weights: Tensors, path: Path) -> None:
    """Put weights, by their names, into a policy or its acting part: all it has, and no others.

    Raises:
        DamageError: a weight that the policy acts by is not finite.
    """
    errors = (AttributeError, RuntimeError, TypeError, ValueError)
    with refusing(f"{path} doesn't fit the run's settings", errors, told=one_line):
        policy.load_state_dict({name: torch.tensor(values) for name, values in weights.items()})
    if not all(bool(torch.isfinite(part).all()) for part in acting(policy).parameters()):
        raise DamageError(f"{path} is damaged: the policy's weights are not finite")


def build(settings: RunSettings, encoder: BaseEncoder, path: Path) -> Trained:
    """The untrained policy of a run, whose settings are from that path."""
    task = settings.environment
    if encoder.fingerprint != settings.encoder:
        raise InputError(f"{encoder.name} is not the encoder that the run in {path} was made with")
    encoder.check_task(task)
    shape = check_shape(settings.algorithm, settings.hyperparameters)
    small = without_buffer(settings.algorithm, shape)
    what = "no policy can be made from the settings of the run"
    errors = (AssertionError, KeyError, TypeError, ValueError)
    with refusing(what, errors, told=one_line), global_random_state_kept():
        spaces = Spaces(*agent_spaces(task, encoder))
        agent = make_agent(settings.algorithm, small, spaces, settings.seed)
    statistics = Statistics.untrained(encoder.latent_size) if shape.normalize else None
    repeat = settings.hyperparameters.action_repeat
    return Trained(agent.policy, task, encoder, settings, None, statistics, repeat)


def pack(trained: Trained, run: str) -> bytes:
    """The bytes of a policy's file, to act with alone; `run` is what its run is called, a line."""
    if not isinstance(trained.encoder, Encoder):
        raise InputError(
            f"the policy of {run} can't be kept in a file: its encoder, {trained.encoder.name}, is "
            "code"
        )
    return _pack(trained, run, {})


def pack_whole(trained: Trained) -> bytes:
    """The bytes of the policy's file in a run's folder, with all that a run can begin with."""
    assert trained.settings is not None
    weights, acts = trained.policy.state_dict(), acting_prefix(trained.policy)
    others = {name: each for name, each in weights.items() if not name.startswith(acts)}
    return _pack(trained, trained.settings.name, _named(TRAINING, others))


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
    tensors |= _named(ACTING, acting(trained.policy).state_dict())
    if isinstance(encoder, Encoder):
        tensors |= {f"{ENCODER}{name}": values for name, values in encoder.tensors().items()}
    if trained.statistics is not None:
        tensors |= trained.statistics.tensors
    return container.pack(tensors, header.as_json())


def _named(prefix: str, weights: Mapping[str, torch.Tensor]) -> Tensors:
    return {f"{prefix}{name}": each.numpy(force=True) for name, each in weights.items()}


def fill_whole(file: PolicyFile, policy: BasePolicy) -> None:
    """As `fill`, with the weights that only training needs, too, which a run's own file has."""
    prefix = acting_prefix(policy)
    acts = {f"{prefix}{name}": values for name, values in file.weights.items()}
    fill(policy, acts | without(TRAINING, file.tensors), file.path)


def of_file(file: PolicyFile) -> Trained:
    """The policy in a file, with the encoder in it.

    Raises:
        InputError, DamageError: it isn't what was written.
    """
    built = build(file.header.settings, file.encoder(), file.path)
    step = None if file.header.finished else file.header.step
    return built.with_weights(file.weights, file.tensors, file.path)._replace(step=step)
