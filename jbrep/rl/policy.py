"""Trained policies, read back."""

import io
import pickle
import textwrap
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy

from jbrep.collect.policies import Actor
from jbrep.encoders import Encoder, find, load
from jbrep.encoders.file import fingerprint
from jbrep.errors import InputError, choose
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import Array, Task, get_task
from jbrep.rl.agent import make_agent, make_env
from jbrep.rl.files import ENCODER, FINISHED, POLICY, read_run
from jbrep.rl.presets import ALGORITHMS, Preset

_WEIGHTS = "policy.pth"
_MAX_BYTES = 1 << 28
_MAX_UNITS = 1 << 12


class Trained(NamedTuple):
    """A policy, and what it acts on."""

    policy: BasePolicy
    task: str
    encoder: Encoder

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Act deterministically; nothing is drawn."""

        def act(observation: Array) -> Array:
            seen = self.encoder.encode(observation.astype(np.float32))
            return self.policy.predict(seen, deterministic=True)[0]

        return act


def load_run(folder: Path) -> Trained:
    """The policy of a finished run; nothing that the folder holds is run as code.

    Of the policy's zip file only the weights are read, as numbers; what they belong to is built
    anew from run.json.

    Raises:
        InputError: no finished run there, or one whose files don't fit together.
    """
    run = read_run(folder)
    if run["status"] != FINISHED:
        raise InputError(f"the run in {folder} {run['status']}: it has no policy")
    return _read(folder, run, _weights(folder / POLICY))


def _read(folder: Path, run: dict[str, Any], weights: dict[str, Any]) -> Trained:
    encoder = load(folder / ENCODER)
    try:
        return _build(run["settings"], encoder, weights)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"the files in {folder} don't fit together: {_line(error)}") from None


def load_untrained(folder: Path) -> Trained:
    """The policy that a run began with.

    Raises:
        InputError: no run that is over there, or one whose files don't fit together.
    """
    return _read(folder, read_run(folder), {})


def load_zip(path: Path, task: str, algorithm: str, encoder: str, trust: bool) -> Trained:
    """The policy of a stable-baselines3 zip file from elsewhere.

    Args:
        path: the file.
        task: a key of TASKS.
        algorithm: a key of ALGORITHMS.
        encoder: what the policy was trained on: a file, or a name that ships.
        trust: whether the file may run code; without it nothing is read.

    Raises:
        InputError: it isn't trusted, or is no such file, or fits neither task nor encoder.
    """
    if not exists(path):
        raise InputError(f"no policy at {path}: a folder of jbrep rl is needed, or a zip file")
    if not trust:
        raise InputError(
            f"{path} is not in a folder of jbrep rl: stable-baselines3 files hold pickled Python, "
            "which runs as code when it is read; --trust, if you know who made it"
        )
    learner = choose(algorithm, ALGORITHMS, "algorithm")
    seen = find(encoder, get_task(task).name)
    try:
        agent = learner.load(path, make_env(task, 1, 0, seen), device="cpu")
    except Exception as error:  # whatever its pickled parts do
        raise InputError(f"{path} is no {algorithm} policy for {task}: {_line(error)}") from None
    return Trained(agent.policy, task, seen)


def _build(settings: dict[str, Any], encoder: Encoder, weights: dict[str, Any]) -> Trained:
    """What was trained, with its weights; without any, as it began."""
    task, algorithm = get_task(settings["task"]).name, settings["algorithm"]
    if fingerprint(encoder) != settings["encoder"]:
        raise InputError(f"{ENCODER} is not the encoder that the run was made with")
    choose(algorithm, ALGORITHMS, "algorithm")
    encoder.check_task(get_task(task))
    hidden = tuple(min(int(units), _MAX_UNITS) for units in settings["hidden"])
    agent = make_agent(
        algorithm, Preset(hidden, {}), make_env(task, 1, 0, encoder), settings["seed"]
    )
    if weights:
        agent.policy.load_state_dict(weights)
    return Trained(agent.policy, task, encoder)


def _weights(path: Path) -> dict[str, Any]:
    """The numbers in a zip file of stable-baselines3, its pickled parts left alone."""
    try:
        with zipfile.ZipFile(path) as file:
            if file.getinfo(_WEIGHTS).file_size > _MAX_BYTES:
                raise InputError(f"{path} is larger than a policy")
            content = io.BytesIO(file.read(_WEIGHTS))
        return torch.load(content, map_location="cpu", weights_only=True)
    except InputError:
        raise
    except (OSError, KeyError, EOFError, RuntimeError, ValueError):
        raise InputError(f"{path} is missing or damaged") from None
    except (zipfile.BadZipFile, pickle.UnpicklingError):
        raise InputError(f"{path} is damaged: it holds no policy's weights") from None


def _line(error: Exception) -> str:
    return textwrap.shorten(str(error), 200)
