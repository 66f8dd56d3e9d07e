"""Beginning a run with the policy of another one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from jbrep.encoders import load
from jbrep.envs.task import Task
from jbrep.errors import InputError, differences
from jbrep.records.record import from_plain
from jbrep.records.storage import write_whole
from jbrep.rl.files import BEGINNING, ENCODER, POLICY, read_finished
from jbrep.rl.normalization import Statistics
from jbrep.rl.overrides import shaping
from jbrep.rl.weights import fill, read_file, read_policy


def policy_to_begin_with(folder: Path, settings: Mapping[str, Any], latent_size: int) -> str:
    """The SHA-256 of a finished run's policy, once it is sure that a run can begin with it.

    Args:
        folder: of the finished run.
        settings: of the run that is to begin.
        latent_size: of its encoder.

    Raises:
        InputError: the run in the folder isn't finished, or differs in algorithm, network or in
            the size of observation, latent or action.
        DamageError: a file of it isn't what was written.
    """
    run = read_finished(folder)
    there = _sizes(run["settings"], run.get("latent_size") or load(folder / ENCODER).latent_size)
    if differing := differences(there, _sizes(settings, latent_size)):
        raise InputError(
            f"can't begin with the policy in {folder}, whose algorithm, network and sizes must be "
            f"the same: {differing}"
        )
    return str(run["policy_sha256"])


def _sizes(settings: Mapping[str, Any], latent_size: int) -> dict[str, Any]:
    """What decides the names and shapes of a policy's weights."""
    task = from_plain(settings["environment"], Task)
    return {
        "algorithm": settings["algorithm"],
        "hidden": settings["hidden"],
        **settings["policy"],
        **shaping(settings["settings"]),
        "normalize": settings["normalize"],
        "features": task.size,
        "latent": latent_size,
        "actions": task.action_size,
    }


def begin(agent: BaseAlgorithm, source: Path, sha256: str, folder: Path) -> None:
    """Give an untrained agent the weights of a finished run's policy, and what normalises its view.

    Args:
        agent: untrained.
        source: the folder of the finished run.
        sha256: of its policy, see `policy_to_begin_with`.
        folder: of the run that begins, where a copy is kept.

    Raises:
        InputError: the weights can't be read, or don't fit.
        DamageError: they aren't what was written.
    """
    path = source / POLICY
    stored = read_policy(path, sha256)
    fill(agent.policy, stored.weights, path)
    if normalizer := agent.get_vec_normalize_env():
        (size,) = agent.observation_space.shape or ()
        Statistics.read(stored.tensors, size, path).give(normalizer)
    write_whole(folder / BEGINNING, read_file(path))
