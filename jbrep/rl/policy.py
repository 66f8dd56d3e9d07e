"""Trained policies: what acts, on what; read back from runs and files, and kept with data."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from jbrep.dataset.settings import MAX_LETTERS, TRAINED
from jbrep.encoders import Encoder, find, load
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.shipped import make
from jbrep.encoders.vec_env import agent_spaces
from jbrep.envs.recording import Actor, held
from jbrep.envs.task import Array, Task, check_same
from jbrep.errors import DamageError, InputError, differences, refusing
from jbrep.records import container
from jbrep.records.container import Tensors, without
from jbrep.records.record import to_plain
from jbrep.records.storage import exists, read_file
from jbrep.rl.agent import (
    Spaces,
    acting,
    deterministic_actor,
    global_random_state_kept,
    make_agent,
    one_line,
    preprocessor,
)
from jbrep.rl.checkpoint import PARAMETERS, Checkpoint
from jbrep.rl.files import (
    CHECKPOINT,
    ENCODER,
    POLICY,
    RUN,
    SOON,
    PolicyHeader,
    is_policy_file,
    is_run,
    read_finished,
)
from jbrep.rl.normalization import Statistics
from jbrep.rl.overrides import check_shape, without_buffer
from jbrep.rl.policy_file import ACTING, ENCODING, TRAINING, PolicyFile, read, unpack
from jbrep.rl.run_settings import RunSettings
from jbrep.text import printable
from jbrep.training.trainer import single_torch_thread


class Trained(NamedTuple):
    """A policy, and what it acts on."""

    policy: BasePolicy
    task: Task
    encoder: BaseEncoder
    settings: RunSettings
    step: int | None = None  # of training, if it is not over
    statistics: Statistics | None = None  # by which it normalises what it sees, if it does

    @property
    def representation(self) -> str:
        """What the policy observes, as tables call it."""
        return self.settings.representation

    @property
    def evaluation_episodes(self) -> int:
        """That the run's evaluations play at once."""
        return 1 if self.settings.one_robot else self.settings.evaluation_episodes

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
        repeat = self.settings.hyperparameters.action_repeat
        return held(_finite(act), repeat, self.settings.chunk)

    def with_weights(self, weights: Tensors, tensors: Tensors, source: Path) -> "Trained":
        """The policy with weights of the part that acts, and statistics among tensors."""
        fill(acting(self.policy), weights, source)
        if not self.settings.hyperparameters.normalize:
            return self
        return self._replace(statistics=Statistics.read(tensors, self.encoder.latent_size))


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
    """Put weights, by their names, into a policy or its acting part: all it has, and no others."""
    errors = (AttributeError, RuntimeError, TypeError, ValueError)
    with refusing(f"{path} doesn't fit the run's settings", errors, describe=one_line):
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
    with refusing(what, errors, describe=one_line), global_random_state_kept():
        spaces = Spaces(*agent_spaces(task, encoder, settings.chunk))
        agent = make_agent(settings.algorithm, small, spaces, settings.seed)
    return Trained(agent.policy, task, encoder, settings)


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
    weights, acts = trained.policy.state_dict(), acting_prefix(trained.policy)
    others = {name: each for name, each in weights.items() if not name.startswith(acts)}
    return _pack(trained, trained.settings.name, _named(TRAINING, others))


def _pack(trained: Trained, run: str, tensors: Tensors) -> bytes:
    settings, encoder = trained.settings, trained.encoder
    header = PolicyHeader(
        settings=settings,
        encoder=encoder.header.as_json() if isinstance(encoder, Encoder) else None,
        run=run,
        step=settings.steps if trained.step is None else trained.step,
        finished=trained.step is None,
    )
    tensors |= _named(ACTING, acting(trained.policy).state_dict())
    if isinstance(encoder, Encoder):
        tensors |= {f"{ENCODING}{name}": values for name, values in encoder.tensors().items()}
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
    """The policy in a file, with the encoder in it."""
    built = build(file.header.settings, file.encoder(), file.path)
    step = None if file.header.finished else file.header.step
    return built.with_weights(file.weights, file.tensors, file.path)._replace(step=step)


def load_run(folder: Path, encoder: Any = None) -> Trained:
    """The policy of a run; nothing that the folder holds is run as code.

    A finished run has its final policy, also while it goes on with more steps; one that is under
    way or was stopped has its checkpoint's. Only numbers are read of either; the network that they
    belong to is built from the run's settings.

    Args:
        folder: of the run.
        encoder: the one that the run was made with, where its folder has none because it is a
            user's own; whatever `jbrep.encoders.find` takes. Code whose module was imported on
            request is known without it.
    """
    if not is_run(folder):
        raise InputError(f"no run in {folder}: {RUN} or {CHECKPOINT} is expected, {SOON}")
    if exists(folder / RUN):
        run, sha256 = read_finished(folder)
        policy = read(folder / POLICY, sha256)
        built = _untrained(folder, run.settings, encoder)
        return built.with_weights(policy.weights, policy.tensors, policy.path)
    path, header, tensors = Checkpoint.read(folder)
    built = _untrained(folder, header.settings, encoder)._replace(step=header.step)
    part = f"{PARAMETERS}policy.{acting_prefix(built.policy)}"
    weights = {
        name: values
        for name, values in without(part, tensors).items()
        if not name.startswith("optimizer.")
    }
    return built.with_weights(weights, tensors, path)


def _untrained(folder: Path, settings: RunSettings, given: Any) -> Trained:
    with single_torch_thread():  # as in training, so that a module computes the same bits
        if given is None:
            encoder = run_encoder(folder, settings)
        else:
            encoder = find(given, settings.environment)
    return build(settings, encoder, folder)


def run_encoder(folder: Path, settings: RunSettings) -> BaseEncoder:
    """The encoder in a run's folder, or what its code makes."""
    if exists(folder / ENCODER):
        return load(folder / ENCODER)
    if settings.encoder_code:
        return make(settings.encoder_code, settings.environment)
    raise InputError(
        f"no {ENCODER} in {folder}: a run on a Python object needs it again, as in "
        "jbrep.load_policy(folder, encoder)"
    )


def policy_to_begin_with(folder: Path, settings: RunSettings, latent_size: int) -> str:
    """The SHA-256 of a finished run's policy, once it is sure that a run can begin with it.

    That run's folder is given, and the settings and latent size of the one that is to begin.
    """
    run, sha256 = read_finished(folder)
    there, here = _sizes(run.settings, run.latent_size), _sizes(settings, latent_size)
    if differing := differences(there, here):
        raise InputError(
            f"can't begin with the policy in {folder}, whose algorithm, network and sizes must be "
            f"the same: {differing}"
        )
    read(folder / POLICY, sha256)  # before anything of the run is written
    return sha256


def _sizes(settings: RunSettings, latent_size: int) -> dict[str, Any]:
    """What decides the names and shapes of a policy's weights."""
    shape = check_shape(settings.algorithm, settings.hyperparameters)
    return {
        "algorithm": settings.algorithm,
        "net_arch": to_plain(shape.net_arch),
        **shape.policy_kwargs,
        "normalize": shape.normalize,
        "features": settings.environment.size,
        "latent": latent_size,
        "actions": settings.environment.action_size * settings.chunk,
    }


@dataclass(frozen=True)
class Frozen:
    """The policy of a run as a data set keeps it: in a file beside the shards.

    It acts deterministically, in one episode at a time: a network rounds differently in batches of
    other sizes, and on several threads.
    """

    file: str  # its name in the data set's folder
    content: bytes  # of the file

    def settings(self) -> dict[str, Any]:
        """What a manifest says of it."""
        header, _ = _opened(self.file, self.content)
        digest = hashlib.sha256(self.content).hexdigest()
        origin = {"run": header.run, "step": header.step}
        return {"kind": TRAINED, "file": self.file, "sha256": digest, **origin}

    def files(self) -> dict[str, bytes]:
        """The file that belongs to the data set."""
        return {self.file: self.content}

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        """Act deterministically; nothing is drawn."""
        header, trained = _opened(self.file, self.content)
        check_same(task, trained.task, header.run)
        return trained.one_by_one()


@lru_cache(maxsize=8)
def _opened(file: str, content: bytes) -> tuple[PolicyHeader, Trained]:
    policy = unpack(content, Path(file))
    return policy.header, of_file(policy)


def freeze(source: str, path: Path, file: str) -> Frozen:
    """The policy of a run's folder or a policy's file, under its name in a data set.

    Manifests call it `source`.
    """
    if is_policy_file(path):
        return Frozen(file, read_file(path))
    if not exists(path / ENCODER):
        raise InputError(
            f"{source} can't be collected with: its encoder is code, which can't be kept with the "
            "data"
        )
    return Frozen(file, pack(load_run(path), _line(source)))


def kept(source: str, path: Path) -> Frozen | None:
    """The policy that a data set has already in a file, if it is that of the source."""
    if not exists(path):
        return None
    found = Frozen(path.name, read_file(path))
    return found if found.settings()["run"] == _line(source) else None


def _line(source: str) -> str:
    return printable(str(Path(source)))[-MAX_LETTERS:]
