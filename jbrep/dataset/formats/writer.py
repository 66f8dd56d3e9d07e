"""Writing a data set of episodes that were made elsewhere: one pass to see them, one to write."""

import math
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from msgspec import UNSET
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import CLOCKS, ENDS, Incoming, Source, single
from jbrep.dataset.formats.missing import count_missing, without_missing
from jbrep.dataset.manifest import Manifest, commit, new_manifest, write_manifest
from jbrep.dataset.rewards import reward_function, with_hash, without_range
from jbrep.dataset.schema import EPISODES, Columns, DataSettings
from jbrep.dataset.settings import IMPORTED, MAX_LETTERS
from jbrep.dataset.verify import range_problems
from jbrep.envs.description import with_features
from jbrep.envs.probe import Signals, features_of, precision_problems
from jbrep.envs.task import Missing, Task
from jbrep.errors import InputError, Notice, kind_and_line
from jbrep.progress import Progress
from jbrep.records.record import converted
from jbrep.records.storage import check_space, make_folder, publish, unfinished
from jbrep.text import counted, printable

_SHARD_ROWS = 20_000
_MOST_SHARDS = 5_000

Array = NDArray[Any]


class _Survey(NamedTuple):
    """What all episodes are like."""

    lengths: list[int]
    size: int  # of an observation
    low: Array  # of the actions, (k,)
    high: Array
    signals: Signals


def write(
    source: Source,
    folder: Path,
    task: Task | None = None,
    features: Path | None = None,
    missing: str = "",
    reward: str = "",
) -> Manifest:
    """Write a data set, whole or not at all.

    Args:
        source: the episodes; read twice.
        folder: new.
        task: that they are of; by default the one that the source names, or else one that is made
            from the data alone.
        features: a TOML file of what else is known of the features, as `describe` takes it.
        missing: what becomes of numbers that aren't finite, see `without_missing`; by default as
            the task says.
        reward: code, as module:function, that gives rewards in place of the source's, (n,), of the
            observations (n, d) and actions (n, k) of an episode, as the data set has them: without
            the offsets of features.
    """
    if missing:
        converted(missing, Missing, "missing")
    make_folder(folder.parent)
    try:
        with unfinished(folder) as partial:
            missing = missing or (task.missing if task else "") or ""
            if task:
                _check_alike(source, task)
            survey = _survey(source, missing)
            fitting = _fitting(source, survey, task or source.task)
            fitting = with_features(fitting, features) if features else fitting
            given = survey.signals.plus(np.asarray(source.subtracted))
            for problem in precision_problems(fitting, given):
                warnings.warn(problem, Notice, stacklevel=2)
            fitting = fitting.replace(missing=missing) if missing else fitting
            fitting = without_range(fitting) if reward else fitting
            source = _rewarded(source, reward, missing, fitting) if reward else source
            settings = _settings(source, survey, fitting, reward)
            check_space(folder.parent, settings.steps * settings.row_bytes())
            partial.mkdir()
            manifest = _fill(source, settings, partial)
            publish(partial, folder)
    except OSError as error:
        raise InputError(f"can't write {folder}: {error.strerror or error}") from error
    return manifest


def _rewarded(source: Source, reward: str, missing: str, task: Task) -> Source:
    """A source with rewards of its user's, of what will be stored."""
    rewards, offset = reward_function(reward), _offset(source, task)

    def episodes() -> Iterator[Incoming]:
        for each in _episodes(source, missing):
            observation = single(each.where, "observation", each.observation - offset)
            action = _bounded(task, single(each.where, "action", each.action))
            yield each._replace(reward=rewards(observation, action))

    return replace(source, episodes=episodes, has_rewards=True)


def _episodes(
    source: Source, missing: str, counts: Counter[str] | None = None
) -> Iterator[Incoming]:
    """Those of a source without what is missing in them; what that is may be counted."""
    for whole in source.episodes():
        steps = 0
        for part in without_missing(whole, missing):
            steps += len(part.action)
            yield part
        if counts is not None:
            left = len(whole.action) - steps
            counts.update(missing=count_missing(whole), left=left, cut=whole.is_cut)


def _survey(source: Source, missing: str) -> _Survey:
    sizes, lengths, counts = (0, 0), list[int](), Counter[str]()
    signals: Signals | None = None
    low: Any = np.inf
    high: Any = -np.inf
    with Progress(total=source.rows, unit="step", unit_scale=True, desc="read") as progress:
        for episode in _episodes(source, missing, counts):
            found = episode.observation.shape[1], episode.action.shape[1]
            sizes = sizes if lengths else found
            if found != sizes:
                raise InputError(
                    f"{source.name} has {found[0]} features and {found[1]} numbers in an action in "
                    f"an episode, but {sizes[0]} and {sizes[1]} before: all must be alike"
                )
            seen = Signals.of([episode.observation])
            signals = signals.with_more(seen) if signals else seen
            low = np.minimum(low, episode.action.min(axis=0))
            high = np.maximum(high, episode.action.max(axis=0))
            lengths.append(len(episode.reward))
            progress.update(lengths[-1])
    if counts["missing"]:
        told = f"{source.name} had {counted(counts['missing'], 'missing reading')} ({missing})"
        told += f": {counted(counts['left'], 'step')} left out" if counts["left"] else ""
        warnings.warn(told, Notice, 2)
    if counts["cut"]:
        told = f"the last step of {counted(counts['cut'], 'episode')} of {source.name} is left out"
        warnings.warn(f"{told}: what was observed after it isn't known", Notice, 2)
    if signals is None:
        if source.rows == 0:
            raise InputError(f"{source.name} has no rows")
        done = (f"; {counted(n, noun)} {what}" for (noun, what), n in source.changes().items())
        raise InputError(
            f"{source.name} has no step: an episode needs two rows, as the last one only says what "
            f"was observed after the last action{''.join(done)}"
        )
    low, high = low.astype(np.float32), high.astype(np.float32)
    return _Survey(lengths, sizes[0], low, high, signals)


def _check_alike(source: Source, task: Task) -> None:
    """Refuse features that are named as the task's but are others, and another clock."""
    for own, each in zip(task.features, source.features, strict=False):
        if each.name != own.name and each.name in task.feature_names:
            raise InputError(
                f"{source.name} has {each.name!r} where {task.name} has {own.name!r}: name the "
                f"observations in the order of jbrep env {task.name}"
            )
        if each.name == own.name and each.unit and own.unit and each.unit != own.unit:
            raise InputError(
                f"{source.name} has {each.name!r} in {each.unit}, and {task.name} in {own.unit}: "
                "bring it to that unit"
            )
    step, expected = source.timestep, task.timestep
    if step and expected and not math.isclose(step, expected, rel_tol=CLOCKS):
        raise InputError(
            f"rows of {source.name} are {step:.4g} s apart, but steps of {task.name} take "
            f"{expected:.4g} s: give --rate {1 / expected:.6g}"
        )


def _fitting(source: Source, survey: _Survey, task: Task | None) -> Task:
    """The task with nothing of its states, or one made from the data alone."""
    if task is None:
        return _from_data(source, survey)
    sizes = (survey.size, len(survey.low))
    if sizes != (task.size, task.action_size):
        raise InputError(
            f"{source.name} has {sizes[0]} features and {sizes[1]} numbers in an action, but "
            f"{task.name} has {task.size} and {task.action_size}: give the task that it is of"
        )
    if (longest := max(survey.lengths)) > task.max_episode_steps:
        raise InputError(
            f"{source.name} has an episode of {longest:,} steps, but {task.name} has at most "
            f"{task.max_episode_steps:,}: give --episode-steps {longest}"
        )
    return task.replace(state={}, constants={})


def _from_data(source: Source, survey: _Survey) -> Task:
    box = spaces.Box(-np.inf, np.inf, (survey.size,))
    low, high = _action_bounds(source, survey)
    if source.features and len(source.features) != survey.size:
        raise InputError(
            f"{source.name} has {survey.size} features, and names of {len(source.features)}: the "
            "two must be equal"
        )
    features = source.features or tuple(features_of(source.label, box))
    subtracted = np.broadcast_to(source.subtracted, survey.size).tolist()
    offsets = {each.name: by for each, by in zip(features, subtracted, strict=True) if by}
    try:
        return Task(
            id=source.label,
            name=source.label,
            features=features,
            offsets=offsets or UNSET,
            action_low=tuple(low.tolist()),
            action_high=tuple(high.tolist()),
            max_episode_steps=max(max(survey.lengths), source.max_episode_steps or 0),
            timestep=source.timestep,
            reproducible=False,
        )
    except ValueError as error:
        raise InputError(f"{source.name} makes no task: {kind_and_line(error)}") from None


def _action_bounds(source: Source, survey: _Survey) -> tuple[Array, Array]:
    """Those given; the extrema of the data where there are none, which a constant is amid."""
    beside = np.where(survey.low == survey.high, np.fmax(1, np.spacing(abs(survey.low))), 0)
    low = survey.low - beside.astype(np.float64)
    high = survey.high + beside.astype(np.float64)
    if source.action_bounds is None:
        return low, high
    given = (np.asarray(ends, np.float32).astype(np.float64) for ends in source.action_bounds)
    below, above = (
        np.where(np.isfinite(ends), ends, own) for ends, own in zip(given, (low, high), strict=True)
    )
    return below, above


def _settings(source: Source, survey: _Survey, task: Task, reward: str) -> DataSettings:
    steps = sum(survey.lengths)
    rows = max(_SHARD_ROWS, steps // _MOST_SHARDS)
    return DataSettings(
        task=task,
        policy={"kind": IMPORTED, "source": printable(source.name)[-MAX_LETTERS:]},
        unrewarded=UNSET if source.has_rewards else True,
        reward=with_hash(reward) if reward else UNSET,
        steps=steps,
        shard_episodes=max(1, rows * len(survey.lengths) // steps),
    )


def _fill(source: Source, settings: DataSettings, folder: Path) -> Manifest:
    manifest = new_manifest(settings)
    write_manifest(folder, manifest)
    offset = _offset(source, settings.task)
    episodes = _episodes(source, settings.task.missing or "")
    with Progress(total=settings.steps, unit="step", unit_scale=True, desc="write") as progress:
        while some := list(islice(episodes, settings.shard_episodes)):
            columns = _columns(settings, some, manifest.episodes, offset)
            for problem in range_problems(settings.task, columns):
                raise InputError(
                    f"{source.name} doesn't fit {settings.task.name}: {problem}; correct the data, "
                    "or give the task that they are of"
                )
            manifest = commit(folder, manifest, columns)
            progress.update(len(columns["step"]))
    if manifest.rows != settings.steps:
        raise InputError(f"{source.name} changed while it was imported: try again")
    return manifest


def _columns(
    settings: DataSettings, episodes: list[Incoming], first: int, offset: Array | float
) -> Columns:
    """The columns of a shard."""

    def rows(what: str, values: list[Array]) -> NDArray[np.float32]:
        given = zip(episodes, values, strict=True)
        return np.concatenate([single(episode.where, what, each) for episode, each in given])

    action = rows("action", [episode.action for episode in episodes])
    finals = [episode.final[None] - offset for episode in episodes]
    ends = {name: np.array([getattr(e, name) for e in episodes]) for name in ENDS}
    known = {
        EPISODES + "episode": np.arange(first, first + len(episodes)),
        EPISODES + "seed": np.array([episode.seed for episode in episodes]),
        EPISODES + "length": np.array([len(episode.reward) for episode in episodes]),
        EPISODES + "missing": np.array([episode.missing for episode in episodes]),
        "observation": rows("observation", [episode.observation - offset for episode in episodes]),
        "action": _bounded(settings.task, action),
        "reward": rows("reward", [episode.reward for episode in episodes]),
        EPISODES + "terminated": ends["terminated"],
        EPISODES + "truncated": ends["truncated"] | ~ends["terminated"],
        EPISODES + "final_observation": rows("final observation", finals),
    }
    return settings.columns(known)


def _offset(source: Source, task: Task) -> Array | float:
    """What is still to be taken off observations."""
    return task.offset - source.subtracted


def _bounded(task: Task, action: Array) -> Array:
    """Actions that only rounding to 32 bits took beyond a bound, on that bound."""
    low, high = (np.array(ends, np.float32) for ends in (task.action_low, task.action_high))
    inside = np.clip(action, low, high)
    rounded = np.abs(action - inside) <= np.spacing(np.abs(action))
    return np.where(rounded, inside, action)
