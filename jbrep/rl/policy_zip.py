"""policy.zip, for stable-baselines3 and other programs, and such files from elsewhere.

Equal runs have equal bytes.
"""

import io
import json
import pickle
import warnings
import zipfile
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import safetensors.numpy
import stable_baselines3
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.save_util import data_to_json
from stable_baselines3.common.vec_env import VecNormalize

from jbrep.encoders import find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.shipped import unscaled
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError, refusing
from jbrep.records.document import Document, document_from, parse_json
from jbrep.records.record import Sha256
from jbrep.records.storage import read_file
from jbrep.rl.agent import action_repeat, is_action_scaled, one_line, statistics_of
from jbrep.rl.normalization import Statistics
from jbrep.rl.policy import Trained
from jbrep.rl.presets import sb3_class
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import Name

STATISTICS = "observation_statistics.safetensors"  # by which an agent normalises what it sees
_HEADER = "trained_on.json"
_OF_TRAINING = {
    "action_noise",  # which may be jbrep's own
    "replay_buffer_class",  # `load` finds the one for n_steps, and warns of one that is given
}
_OF_THIS_PROCESS = {  # wall times, and where the environment was: `load` starts with defaults
    "_last_episode_starts",
    "_current_progress_remaining",
    "_last_obs",
    "_last_original_obs",
    "_num_timesteps_at_start",
    "ep_info_buffer",
    "ep_success_buffer",
    "start_time",
}


class ZipHeader(Document, frozen=True, kw_only=True):
    """What policy.zip says beside what stable-baselines3 reads."""

    format = "jbrep policy.zip"
    format_version = 2

    environment: Task  # of the run
    encoder: Sha256  # the fingerprint of that through which its agent observes
    representation: Name  # what tables call that


class ZipMetadata(NamedTuple):
    """What a zip file that jbrep wrote says beside what stable-baselines3 reads."""

    header: ZipHeader
    statistics: dict[str, NDArray[Any]]  # see `jbrep.rl.normalization.Statistics`; perhaps none


def policy_zip(agent: BaseAlgorithm, settings: RunSettings) -> bytes:
    """A zip file that the algorithm's `load` takes, as its `save` writes it.

    Unlike there, members carry a fixed date, whatever the clock says, and nothing in them depends
    on the process or the machine. What the agent observes through, and statistics by which it
    normalises that, are members that `load` leaves alone.
    """
    names, variables = agent._get_torch_save_params()
    left_out = {*agent._excluded_save_params(), *_OF_THIS_PROCESS, *_OF_TRAINING}
    left_out |= {name.partition(".")[0] for name in (*names, *variables)}
    data = {name: value for name, value in vars(agent).items() if name not in left_out}
    statistics = statistics_of(agent)
    header = ZipHeader(
        environment=settings.environment,
        encoder=settings.encoder,
        representation=settings.representation,
    )
    members: dict[str, str | bytes] = {
        "data": _to_json(data),
        "pytorch_variables.pth": _to_bytes({name: getattr(agent, name) for name in variables}),
        **{f"{name}.pth": _to_bytes(state) for name, state in agent.get_parameters().items()},
        "_stable_baselines3_version": stable_baselines3.__version__,
        _HEADER: header.text(),
        **({STATISTICS: safetensors.numpy.save(statistics.tensors)} if statistics else {}),
    }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name, member in members.items():
            file.writestr(zipfile.ZipInfo(name), member)  # dated 1980, the format's first year
    return content.getvalue()


def read_metadata(raw: bytes, path: Path) -> ZipMetadata | None:
    """What a zip file's bytes say; None if jbrep didn't write them. The path is for messages."""
    members = zipfile.ZipFile(io.BytesIO(raw))
    if _HEADER not in members.namelist():
        return None
    told = parse_json(members.read(_HEADER), path, ZipHeader.format)
    has_statistics = STATISTICS in members.namelist()
    statistics = safetensors.numpy.load(members.read(STATISTICS)) if has_statistics else {}
    return ZipMetadata(document_from(told, path, ZipHeader), statistics)


def _to_json(data: dict[str, Any]) -> str:
    """stable-baselines3's JSON without its notes for human readers, which hold addresses."""
    stated = json.loads(data_to_json(data))
    for name, value in stated.items():
        if isinstance(value, dict) and ":serialized:" in value:
            stated[name] = {key: value[key] for key in (":type:", ":serialized:")}
    return json.dumps(stated, indent=4)


def _to_bytes(tensors: dict[str, Any]) -> bytes:
    content = io.BytesIO()
    torch.save(tensors, content)
    return content.getvalue()


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

    It sees observations as the environment gives them unless something else is said: by the file,
    if jbrep wrote it, or by an encoder's file or name and by what `VecNormalize.save` wrote. A
    file that doesn't say its task needs one. Nothing is read unless it is trusted to run code.
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
    statistics = _statistics(vecnormalize, seen.latent_size)
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
    return trained._replace(statistics=Statistics.read(statistics))


def _checked(agent: BaseAlgorithm, task: Task, seen: BaseEncoder, path: Path) -> Trained:
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
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise InputError(f"{path} observes {one_line(space)}: it must be a Box of one dimension")
    if space.shape[0] != seen.latent_size:
        what = f"{seen.task.name} has" if seen.size == seen.latent_size else f"{seen.name} shows"
        raise InputError(
            f"{path} observes {space.shape[0]} numbers, where {what} {seen.latent_size}: give the "
            "--task that it was trained on, and the --encoder, if there was one"
        )


def _check_actions(space: spaces.Space[Any], task: Task, path: Path) -> None:
    low, high = (np.array(bound, np.float32) for bound in (task.action_low, task.action_high))
    if isinstance(space, spaces.Box) and space.shape == low.shape:
        own = (space.low, low), (space.high, high)
        if is_action_scaled(space) or all(np.allclose(*each, rtol=1e-5) for each in own):
            return
    raise InputError(
        f"{path} acts in {one_line(space)}, where {task.name} acts from {one_line(low)} to "
        f"{one_line(high)}: its bounds must be these, or -1 to 1"
    )


def _statistics(path: Path, size: int) -> Statistics | None:
    """What a VecNormalize normalises observations by; None if it leaves them as they are."""
    with refusing(f"{path} isn't what VecNormalize.save wrote for this policy", told=one_line):
        normalizer = pickle.loads(read_file(path))
        if not isinstance(normalizer, VecNormalize):
            raise TypeError(f"it holds a {type(normalizer).__name__}")
        if not normalizer.norm_obs:
            return None
        running = cast("RunningMeanStd", normalizer.obs_rms)
        if not isinstance(running, RunningMeanStd) or running.mean.shape != (size,):
            raise ValueError("its statistics are of other observations")
        if not np.isfinite((running.mean, running.var)).all() or running.var.min() < 0:
            raise ValueError("its statistics aren't finite")
        limits = float(normalizer.clip_obs), float(normalizer.epsilon)
        return Statistics(running.mean, running.var, 0.0, *limits)


def _note(path: Path) -> str:
    beside = sorted(each for each in path.parent.glob("*.pkl") if "normal" in each.name.lower())
    where = str(beside[0]) if len(beside) == 1 else "FILE"
    return (
        f"{path} doesn't say what its agent was trained to see: add --vecnormalize {where} if that "
        "was behind VecNormalize, --encoder full if in JitterbugVecEnv"
    )
