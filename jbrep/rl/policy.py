"""Trained policies, read back from the folders of runs."""

from pathlib import Path
from typing import Any

from jbrep.encoders import find, load
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.shipped import make
from jbrep.errors import InputError, differences
from jbrep.records.container import without
from jbrep.records.record import to_plain
from jbrep.records.storage import exists
from jbrep.rl.checkpoint import PARAMETERS, Checkpoint, run_settings
from jbrep.rl.files import (
    BEGINNING,
    CHECKPOINT,
    ENCODER,
    POLICY,
    RUN,
    SOON,
    is_run,
    read_finished,
)
from jbrep.rl.overrides import check_shape
from jbrep.rl.policy_file import read
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.trained import Trained, acting_prefix, build
from jbrep.training.trainer import single_torch_thread


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

    Raises:
        DamageError: a file isn't what was written.
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


def load_untrained(folder: Path) -> Trained:
    """The policy that a run began with.

    Raises:
        DamageError: a file isn't what was written.
    """
    settings = run_settings(folder)
    built = _untrained(folder, settings, None)
    if settings.begin_from is None:
        return built
    policy = read(folder / BEGINNING, settings.begin_from)
    return built.with_weights(policy.weights, policy.tensors, policy.path)


def _untrained(folder: Path, settings: RunSettings, given: Any) -> Trained:
    """What a run trains, as it begins unless another run's policy comes along."""
    with single_torch_thread():  # as in training, so that a module computes the same bits
        if given is None:
            encoder = run_encoder(folder, settings)
        else:
            encoder = find(given, settings.environment)
    return build(settings, encoder, folder)


def run_encoder(folder: Path, settings: RunSettings) -> BaseEncoder:
    """The encoder in a run's folder, or what its code makes.

    Raises:
        DamageError: its file isn't what was written.
    """
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

    Raises:
        DamageError: a file of it isn't what was written.
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
        **shape.algorithm_kwargs,
        **shape.policy_kwargs,
        "normalize": shape.normalize,
        "features": settings.environment.size,
        "latent": latent_size,
        "actions": settings.environment.action_size,
    }
