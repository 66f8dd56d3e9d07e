"""Policies of stable-baselines3's zip files from elsewhere, on what they were trained to see."""

import io
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from jbrep.encoders import find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.shipped import unscaled
from jbrep.envs.task import Array, Task, check_same
from jbrep.errors import InputError, refusing
from jbrep.records.storage import read_file
from jbrep.rl.agent import action_repeat, is_action_scaled, one_line
from jbrep.rl.normalization import Statistics
from jbrep.rl.policy_zip import ZipMetadata, read_metadata
from jbrep.rl.presets import sb3_class
from jbrep.rl.trained import Trained

_PARTS = (spaces.Box, spaces.Discrete, spaces.MultiBinary)  # which `deterministic_actor` knows
_OTHERS = "its statistics are of other observations"


class Zipped(NamedTuple):
    """A policy from a zip file."""

    trained: Trained
    note: str  # what the file doesn't tell; empty if it does


def load_zip(
    path: Path,
    task: Task | None,
    algorithm: str,
    encoder: str | None = None,
    trust: bool = False,
    vecnormalize: Path | None = None,
) -> Zipped:
    """The policy of a stable-baselines3 zip file from elsewhere.

    It sees observations as the environment gives them, in the zip file's own spaces, unless
    something else is said: by the file, if jbrep wrote it, or by the arguments.

    Args:
        path: the file.
        task: which the policy was trained on; None if the file says it.
        algorithm: a key of CLASSES.
        encoder: through which the policy was trained: a file, or the name of one that ships.
        trust: whether the files may run code; without it nothing is read.
        vecnormalize: what `VecNormalize.save` wrote, with the statistics by which the policy was
            trained to see.
    """
    if not trust:
        raise InputError(
            f"{path} is not in a folder of jbrep rl: stable-baselines3 files hold pickled Python, "
            "which runs as code when it is read; add --trust if you know who made it"
        )
    raw = read_file(path)
    agent, told = _loaded(raw, path, algorithm)
    if told:
        return Zipped(_as_told(agent, told, path, task, encoder, vecnormalize), "")
    if task is None:
        raise InputError(f"{path} doesn't say its task: give the --task that it was trained on")
    seen = unscaled(task) if encoder is None else find(encoder, task)
    trained = _checked(agent, task, seen, path)
    if vecnormalize is None:
        return Zipped(trained, _note(path))
    statistics = _statistics(vecnormalize, agent.observation_space)
    return Zipped(trained._replace(statistics=statistics), "")


def _as_told(
    agent: BaseAlgorithm,
    told: ZipMetadata,
    path: Path,
    task: Task | None,
    encoder: str | None,
    vecnormalize: Path | None,
) -> Trained:
    """The policy of a file that jbrep wrote, on what it says that the agent observed."""
    header, statistics = told
    if task:
        check_same(task, header.environment, str(path))
    if vecnormalize:
        raise InputError(f"{path} has the statistics that it needs: leave out --vecnormalize")
    try:
        seen = find(encoder or header.representation, header.environment)
    except InputError as error:
        if encoder:
            raise
        raise InputError(
            f"{path} was trained on {header.representation}: give that by --encoder ({error})"
        ) from None
    if seen.fingerprint != header.encoder:
        raise InputError(
            f"{path} was trained on {header.representation}, which isn't this {seen.name}: give "
            "that by --encoder"
        )
    trained = _checked(agent, header.environment, seen, path)
    if not statistics:
        return trained
    read = Statistics.read(statistics, seen.latent_size, path)
    return trained._replace(statistics=read)


def _checked(agent: BaseAlgorithm, task: Task, seen: BaseEncoder, path: Path) -> Trained:
    """The policy of an agent, whose spaces fit the task and what is seen of it."""
    _check_observations(agent.observation_space, seen, path)
    _check_actions(agent.action_space, task, path)
    return Trained(agent.policy, task, seen, action_repeat=action_repeat(agent))


def _loaded(raw: bytes, path: Path, algorithm: str) -> tuple[BaseAlgorithm, ZipMetadata | None]:
    kind = sb3_class(algorithm)
    if not zipfile.is_zipfile(io.BytesIO(raw)):
        raise InputError(f"{path} isn't a {algorithm} policy: it isn't a zip file")
    with refusing(f"{path} isn't a {algorithm} policy", told=one_line), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of schedules that another Python pickled
        # what only training needs: memory, or an environment to be made with
        unused: dict[str, Any] = {
            "buffer_size": 1,
            "replay_buffer_class": None,
            "replay_buffer_kwargs": {},
        }
        agent = kind.load(io.BytesIO(raw), device="cpu", custom_objects=unused)
        return agent, read_metadata(raw, path)


def _check_observations(space: spaces.Space[Any], seen: BaseEncoder, path: Path) -> None:
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else (space,)
    if not all(isinstance(part, _PARTS) for part in parts):
        raise InputError(
            f"{path} observes {one_line(space)}: it must be a Box, or a Dict of Box, Discrete and "
            "MultiBinary parts"
        )
    if (size := flatdim(space)) != seen.latent_size:
        what = f"{seen.task.name} has" if seen.size == seen.latent_size else f"{seen.name} shows"
        raise InputError(
            f"{path} observes {size} numbers, where {what} {seen.latent_size}: give the --task "
            "that it was trained on, and the --encoder, if there was one"
        )


def _check_actions(space: spaces.Space[Any], task: Task, path: Path) -> None:
    """Make sure that the policy's actions are in the task's bounds, or scaled to [-1, 1]."""
    low, high = (np.array(bound, np.float32) for bound in (task.action_low, task.action_high))
    if isinstance(space, spaces.Box) and space.shape == low.shape:
        own = (space.low, low), (space.high, high)
        if is_action_scaled(space) or all(np.allclose(*each, rtol=1e-5) for each in own):
            return
    raise InputError(
        f"{path} acts in {one_line(space)}, where {task.name} acts from {_shown(low)} to "
        f"{_shown(high)}: its bounds must be these, or -1 to 1"
    )


def _shown(bounds: NDArray[np.float32]) -> str:
    each = [f"{bound:g}" for bound in bounds[:6].tolist()]
    return ", ".join((*each, "...")[: len(bounds)] if len(bounds) > len(each) else each)


def _statistics(path: Path, space: spaces.Space[Any]) -> Statistics | None:
    """What a VecNormalize normalises observations by, flat; None if it leaves them as they are."""
    with refusing(f"{path} isn't what VecNormalize.save wrote for this policy", told=one_line):
        normalizer = pickle.loads(read_file(path))
        if not isinstance(normalizer, VecNormalize):
            raise TypeError(f"it holds a {type(normalizer).__name__}")
        return _read(normalizer, space) if normalizer.norm_obs else None


def _read(normalizer: VecNormalize, space: spaces.Space[Any]) -> Statistics:
    if isinstance(space, spaces.Dict):
        parts, running = dict(space.spaces), cast("dict[str, RunningMeanStd]", normalizer.obs_rms)
    else:
        parts, running = {"": space}, {"": cast("RunningMeanStd", normalizer.obs_rms)}
    if running.keys() - parts.keys():
        raise ValueError(_OTHERS)
    rows = [_rows(running.get(name), part, normalizer) for name, part in parts.items()]
    mean, variance, clip = np.concatenate(rows, axis=1)
    if not np.isfinite((mean, variance)).all() or variance.min() < 0:
        raise ValueError("its statistics aren't finite")
    return Statistics(mean, variance, 0.0, clip, float(normalizer.epsilon))


def _rows(
    running: RunningMeanStd | None, part: spaces.Space[Any], normalizer: VecNormalize
) -> Array:
    """Mean, variance and limit of the numbers in a part, (3, size); none leaves these alone."""
    if running is None:
        size = flatdim(part)
        return np.stack(
            (np.zeros(size), np.full(size, 1 - normalizer.epsilon), np.full(size, np.inf))
        )
    if not isinstance(running, RunningMeanStd) or running.mean.shape != part.shape:
        raise ValueError(_OTHERS)
    mean, variance = running.mean.ravel(), running.var.ravel()
    return np.stack((mean, variance, np.full(mean.size, normalizer.clip_obs)))


def _note(path: Path) -> str:
    beside = sorted(each for each in path.parent.glob("*.pkl") if "normal" in each.name.lower())
    where = str(beside[0]) if len(beside) == 1 else "FILE"
    return (
        f"{path} doesn't say what its agent was trained to see: add --vecnormalize {where} if that "
        "was behind VecNormalize, --encoder full if in JitterbugVecEnv"
    )
