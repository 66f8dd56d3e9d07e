"""Trained policies, read back."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy

from jbrep.collect.policies import Actor
from jbrep.encoders import Encoder, find, load
from jbrep.encoders.file import fingerprint
from jbrep.errors import DamageError, InputError, choose
from jbrep.files import container
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import EPISODE_STEPS, Array, Task, get_task
from jbrep.rl.agent import make_agent, make_env
from jbrep.rl.checkpoint import MAX_BYTES, PARAMETERS
from jbrep.rl.fields import MAX_STEPS, check_settings, whole_number
from jbrep.rl.files import CHECKPOINT, ENCODER, FINISHED, POLICY, RUN, is_run, read_run
from jbrep.rl.presets import ALGORITHMS, Preset
from jbrep.rl.weights import one_line, read_file, read_weights

_WEIGHTS = f"{PARAMETERS}policy."


class Trained(NamedTuple):
    """A policy, and what it acts on."""

    policy: BasePolicy
    task: str
    encoder: Encoder
    evaluation_episodes: int = 1  # that the run's evaluations play at once
    episode_steps: int = EPISODE_STEPS
    step: int | None = None  # of training, if it is not over

    @property
    def representation(self) -> str:
        """What the policy observes."""
        return self.encoder.representation

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Act deterministically; nothing is drawn."""
        return self._act

    def _act(self, observation: Array) -> Array:
        seen = self.encoder.encode(observation.astype(np.float32))
        try:
            actions = self.policy.predict(seen, deterministic=True)[0]
        except ValueError:  # torch's distributions refuse NaN
            actions = np.full((len(seen), 1), np.nan)
        if not np.isfinite(actions).all():
            raise InputError("the policy's actions are not finite: it can't be played")
        return actions


def load_run(folder: Path) -> Trained:
    """The policy of a run; nothing that the folder holds is run as code.

    A finished run has its final policy, one that is under way or was stopped its checkpoint's. Only
    numbers are read of either; the network that they belong to is built from the run's settings.

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
        return _load_checkpoint(folder)
    run = read_run(folder)
    if run["status"] != FINISHED:
        raise InputError(f"the run in {folder} {run['status']}: it has no policy")
    if "policy_sha256" not in run:
        raise DamageError(f"{folder / RUN} is damaged: policy_sha256 is missing")
    trained = _build(folder, run["settings"])
    return _fill(trained, read_weights(folder / POLICY, run["policy_sha256"]), folder / POLICY)


def load_untrained(folder: Path) -> Trained:
    """The policy that a run began with.

    Raises:
        InputError: as `load_run`.
        DamageError: a file isn't what was written.
    """
    if exists(folder / RUN):
        return _build(folder, read_run(folder)["settings"])
    return _build(folder, _read_checkpoint(folder).settings)


def load_zip(path: Path, task: str, algorithm: str, encoder: str, trust: bool) -> Trained:
    """The policy of a stable-baselines3 zip file from elsewhere.

    Args:
        path: the file.
        task: a key of TASKS.
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
    seen = find(encoder, get_task(task).name)
    content = io.BytesIO(read_file(path.resolve()))
    try:
        agent = learner.load(content, make_env(task, 1, 0, seen), device="cpu")
    except Exception as error:  # whatever its pickled parts do
        raise InputError(f"{path} is no {algorithm} policy for {task}: {one_line(error)}") from None
    return Trained(agent.policy, task, seen)


class _Checkpoint(NamedTuple):
    """What a run under way has kept of its policy."""

    settings: dict[str, Any]
    step: int
    weights: dict[str, torch.Tensor]


def _read_checkpoint(folder: Path) -> _Checkpoint:
    path = folder / CHECKPOINT
    tensors, header = container.read(path, "checkpoint", MAX_BYTES)
    settings, counters = header.get("identity"), header.get("counters")
    if not isinstance(settings, dict) or not isinstance(counters, dict):
        raise DamageError(f"{path} is not a run's checkpoint")
    settings.setdefault("episode_steps", EPISODE_STEPS)
    check_settings(path, settings)
    step = counters.get("num_timesteps", -1)
    if not whole_number(0, MAX_STEPS).allows(step):
        raise DamageError(f"{path} is damaged: its number of steps is {step!r}")
    weights = {
        name.removeprefix(_WEIGHTS): torch.tensor(values)
        for name, values in tensors.items()
        if name.startswith(_WEIGHTS) and not name.startswith(f"{_WEIGHTS}optimizer.")
    }
    return _Checkpoint(settings, step, weights)


def _load_checkpoint(folder: Path) -> Trained:
    checkpoint = _read_checkpoint(folder)
    trained = _build(folder, checkpoint.settings)._replace(step=checkpoint.step)
    return _fill(trained, checkpoint.weights, folder / CHECKPOINT)


def _build(folder: Path, settings: Mapping[str, Any]) -> Trained:
    """What a run trains, as it begins."""
    task, algorithm = get_task(settings["task"]), settings["algorithm"]
    choose(algorithm, ALGORITHMS, "algorithm")
    encoder = load(folder / ENCODER)
    if fingerprint(encoder) != settings["encoder"]:
        raise InputError(f"{folder / ENCODER} is not the encoder that the run was made with")
    encoder.check_task(task)
    preset = Preset(tuple(settings["hidden"]), {})
    agent = make_agent(algorithm, preset, make_env(task.name, 1, 0, encoder), settings["seed"])
    return Trained(
        agent.policy,
        task.name,
        encoder,
        settings["evaluation_episodes"],
        settings["episode_steps"],
    )


def _fill(trained: Trained, weights: Mapping[str, torch.Tensor], path: Path) -> Trained:
    """The same with these weights: all that the policy has, and no others."""
    try:
        trained.policy.load_state_dict(weights)
    except (AttributeError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{path} doesn't fit the run's settings: {one_line(error)}") from None
    acting = getattr(trained.policy, "actor", trained.policy)
    if not all(bool(torch.isfinite(part).all()) for part in acting.parameters()):
        raise DamageError(f"{path} is damaged: the policy's weights are not finite")
    return trained
