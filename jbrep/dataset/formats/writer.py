"""Writing a data set of what was made elsewhere: one pass to see the episodes, one to write."""

import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET

from jbrep.dataset.columns import Array
from jbrep.dataset.formats import open_sources
from jbrep.dataset.formats.arrays import frame_in_python
from jbrep.dataset.formats.clock import same_clock
from jbrep.dataset.formats.episodes import Incoming, count_missing, single, without_missing
from jbrep.dataset.formats.frame import frame_of_table
from jbrep.dataset.formats.source import LAST, Source
from jbrep.dataset.layout import Layout
from jbrep.dataset.manifest import MANIFEST, Manifest, commit, new_manifest, range_problems
from jbrep.dataset.reader import Dataset
from jbrep.dataset.rewards import reward_function, without_range
from jbrep.dataset.schema import EPISODES, Columns, DataSettings, joined
from jbrep.dataset.settings import IMPORTED, MAX_LETTERS, MOST_SHARDS, SHARD_ROWS
from jbrep.envs.description import as_task, with_features
from jbrep.envs.names import is_code, with_digest
from jbrep.envs.probe import Signals, precision_problems
from jbrep.envs.task import Missing, Task
from jbrep.errors import InputError, Notice, kind_and_line
from jbrep.progress import Progress
from jbrep.records.record import converted
from jbrep.records.storage import check_space, make_folder, publish, unfinished
from jbrep.text import counted, printable

Rewards = Callable[[Array, Array], Array]


class _Survey(NamedTuple):
    lengths: list[int]
    low: Array  # of the actions, (k,)
    high: Array
    signals: Signals


def from_arrays(
    folder: str | Path,
    observations: Any,
    actions: Any,
    rewards: Any,
    terminations: Any,
    truncations: Any = None,
    *,
    final_observations: Any = None,
    seeds: Any = None,
    task: Task | str | None = None,
    source: str = "arrays",
) -> Dataset:
    """Write a data set of arrays of n episodes, one after the other, or of lists with one of each.

    Args:
        folder: new.
        observations: before each action, (N, d); in a list, with or without the final one.
        actions: (N, k).
        rewards: (N,); None where none are known.
        terminations: whether a state ended the episode at that step, (N,).
        truncations: whether anything else did, such as a time limit, (N,).
        final_observations: after the last action of each episode, (n, d). Where they aren't known,
            the last step of each episode is left out, so that its observation is the final one.
        seeds: that the episodes were started with, (n,); -1 where one isn't known.
        task: that they are of, or its name; made from the data alone if not given.
        source: where they come from, a few words; also the id of a task made from the data.
    """
    columns = {"observation": observations, "action": actions, "reward": rewards}
    columns |= {"terminated": terminations, "truncated": truncations}
    once = {"final_observation": final_observations, "seed": seeds}
    frame = frame_in_python(columns, once, source)
    return _written(folder, lambda missing: Source(frame, None, missing), task)


def from_table(
    folder: str | Path,
    table: Any,
    layout: Layout | None = None,
    *,
    missing: str = "",
    task: Task | str | None = None,
    source: str = "table",
) -> Dataset:
    """Write a data set of a table's rows, such as a robot's log.

    Args:
        folder: new.
        table: a frame of pandas or polars, a table of pyarrow's, or a dict of columns.
        layout: what its columns are, and what becomes of its rows.
        missing: what becomes of numbers that are missing: skip, or hold:3 and the like.
        task: that the rows are of, or its name; made from the data alone if not given.
        source: where they come from, a few words; also the id of a task made from the data.
    """
    opened = partial(Source, frame_of_table(table, source), layout)
    return _written(folder, opened, task, layout, missing)


def from_file(
    folder: str | Path,
    file: str | Path,
    *more: str | Path,
    layout: Layout | None = None,
    missing: str = "",
    task: Task | str | None = None,
) -> Dataset:
    """Write a data set of others' files, as `jbrep data import` does.

    Args:
        folder: new.
        file: a log, or a data set of another tool, see docs/logs.md.
        more: such files; an episode ends with each.
        layout: as of `from_table`.
        missing: likewise.
        task: likewise; by default the one that the files name, if they do.
    """
    opened = partial(open_sources, [*map(str, (file, *more))], layout)
    return _written(folder, opened, task, layout, missing)


def _written(
    folder: str | Path,
    opened: Callable[[str], Source],
    task: Task | str | None,
    layout: Layout | None = None,
    missing: str = "",
) -> Dataset:
    reward = layout.reward if layout and is_code(layout.reward) else ""
    known = None if task is None else as_task(task)
    missing = missing or (known.missing if known else "") or ""
    source = opened(missing)
    write(source, Path(folder), known, missing=missing, reward=reward)
    if lost := source.changes()[LAST]:
        warnings.warn(f"{counted(lost, LAST[0])} {LAST[1]}", Notice, 3)
    return Dataset(folder)


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
        missing: as `without_missing` takes it.
        reward: code, see `reward_function`, in place of the source's rewards.
    """
    missing = converted(missing, Missing, "missing") if missing else ""
    if task:
        _check_alike(source, task)
    make_folder(folder.parent)
    try:
        with unfinished(folder) as partial:
            survey = _survey(source, missing)
            task = task or source.task
            fitting = _fitting(source, survey, task) if task else _from_data(source, survey)
            fitting = with_features(fitting, features) if features else fitting
            source.interpolate_as(fitting)
            given = Signals(*(ends + source.subtracted for ends in survey.signals))
            for problem in precision_problems(fitting, given):
                warnings.warn(problem, Notice, stacklevel=2)
            fitting = fitting.replace(missing=missing) if missing else fitting
            fitting = without_range(fitting) if reward else fitting
            settings = _settings(source, survey, fitting, reward)
            check_space(folder.parent, settings.steps * settings.row_bytes())
            partial.mkdir()
            rewards = reward_function(reward) if reward else None
            manifest = _fill(source, settings, partial, rewards)
            publish(partial, folder)
    except OSError as error:
        raise InputError(f"can't write {folder}: {error.strerror or error}") from error
    return manifest


def _check_alike(source: Source, task: Task) -> None:
    """Refuse features that are named as the task's but are others, and another clock."""
    features, timestep = source.features, source.timestep
    if source.task:
        features, timestep = source.task.features, timestep or source.task.timestep
    for own, each in zip(task.features, features, strict=False):
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
    if not same_clock(timestep, task.timestep):
        step, expected = timestep or 0, task.timestep or 1
        raise InputError(
            f"rows of {source.name} are {step:.4g} s apart, but steps of {task.name} take "
            f"{expected:.4g} s: give `rate` {1 / expected:.6g}"
        )


def _survey(source: Source, missing: str) -> _Survey:
    lengths, counts, signals = list[int](), Counter[str](), None
    low, high = np.array(np.inf), np.array(-np.inf)
    with Progress(total=source.rows, unit="step", unit_scale=True, desc="read") as progress:
        for whole in source.episodes():
            counts.update(missing=count_missing(whole), left=len(whole.action))
            for episode in without_missing(whole, missing):
                seen = Signals.of(episode.observation)
                signals = signals.joined(seen) if signals else seen
                action = single(episode.where, "action", episode.action)
                low, high = np.minimum(low, action.min(0)), np.maximum(high, action.max(0))
                lengths.append(len(action))
                counts["left"] -= len(action)
                progress.update(len(action))
    if counts["missing"]:
        note = f"{source.name} had {counted(counts['missing'], 'missing reading')} ({missing})"
        note += f": {counted(counts['left'], 'step')} left out" if counts["left"] else ""
        warnings.warn(note, Notice, 2)
    if signals is None:
        done = "".join(f"; {counted(n, what)} {how}" for (what, how), n in source.changes().items())
        raise InputError(
            f"{source.name} has no step: an episode needs two rows, as the last one only says what "
            f"was observed after the last action{done or '; it has no rows'}"
        )
    return _Survey(lengths, low, high, signals)


def _fitting(source: Source, survey: _Survey, task: Task) -> Task:
    """The task with nothing of its states."""
    sizes = len(source.subtracted), len(survey.low)
    if sizes != (task.size, task.action_size):
        raise InputError(
            f"{source.name} has {sizes[0]} features and {sizes[1]} numbers in an action, but "
            f"{task.name} has {task.size} and {task.action_size}: give the task that it is of"
        )
    if (longest := max(survey.lengths)) > task.max_episode_steps:
        raise InputError(
            f"{source.name} has an episode of {longest:,} steps, but {task.name} has at most "
            f"{task.max_episode_steps:,}: give `episode_steps` {longest}"
        )
    return task.replace(state={}, constants={})


def _from_data(source: Source, survey: _Survey) -> Task:
    """A task made from the data alone; a constant action is amid its bounds."""
    beside = np.where(survey.low == survey.high, np.fmax(1, np.spacing(abs(survey.low))), 0)
    low, high = survey.low - beside.astype(float), survey.high + beside.astype(float)
    if source.action_bounds is not None:
        given = source.action_bounds.astype(np.float32)
        low, high = np.where(np.isfinite(given), given, (low, high))
    pairs = zip(source.features, source.subtracted.tolist(), strict=True)
    offsets = {each.name: by for each, by in pairs if by}
    try:
        return Task(
            id=source.frame.label,
            name=source.frame.label,
            features=source.features,
            offsets=offsets or UNSET,
            action_names=source.action_names,
            action_low=tuple(low.tolist()),
            action_high=tuple(high.tolist()),
            max_episode_steps=max(*survey.lengths, source.frame.max_episode_steps or 0),
            timestep=source.timestep,
            reproducible=False,
        )
    except ValueError as error:
        raise InputError(f"{source.name} makes no task: {kind_and_line(error)}") from None


def _settings(source: Source, survey: _Survey, task: Task, reward: str) -> DataSettings:
    steps = sum(survey.lengths)
    rows = max(SHARD_ROWS, steps // MOST_SHARDS)
    return DataSettings(
        task=task,
        policy={"kind": IMPORTED, "source": printable(source.name)[-MAX_LETTERS:]},
        unrewarded=UNSET if source.has_rewards or reward else True,
        reward=with_digest(reward, "reward") if reward else source.frame.own_reward or UNSET,
        steps=steps,
        shard_episodes=max(1, rows * len(survey.lengths) // steps),
    )


def _fill(
    source: Source, settings: DataSettings, folder: Path, rewards: Rewards | None
) -> Manifest:
    manifest, task = new_manifest(settings), settings.task
    manifest.write(folder / MANIFEST)
    missing = task.missing or ""
    episodes = (each for whole in source.episodes() for each in without_missing(whole, missing))
    numbered = enumerate(episodes)
    offset = task.offset - source.subtracted
    with Progress(total=settings.steps, unit="step", unit_scale=True, desc="write") as progress:
        while some := [*islice(numbered, settings.shard_episodes)]:
            known = joined([_columns(task, *pair, offset, rewards) for pair in some])
            columns = settings.columns(known)
            if problem := next(range_problems(task, columns), None):
                raise InputError(
                    f"{source.name} doesn't fit {task.name}: {problem}; correct the data, or give "
                    "the task that they are of"
                )
            manifest = commit(folder, manifest, columns)
            progress.update(len(columns["step"]))
    if manifest.rows != settings.steps or source.has_changed():
        raise InputError(f"{source.name} changed while it was imported: try again")
    return manifest


def _columns(
    task: Task, number: int, episode: Incoming, offset: Array, rewards: Rewards | None
) -> Columns:
    """The columns of an episode that don't follow from others."""
    where, is_terminated = episode.where, episode.terminated
    observation = single(where, "observation", episode.observation - offset)
    action = _bounded(task, single(where, "action", episode.action))
    reward = rewards(observation, action) if rewards else episode.reward
    once = {
        "episode": number,
        "seed": episode.seed,
        "length": len(action),
        "missing": episode.missing,
        "terminated": is_terminated,
        "truncated": episode.truncated or not is_terminated,
    }
    return {
        "observation": observation,
        "action": action,
        "reward": single(where, "reward", reward),
        EPISODES + "final_observation": single(where, "final one", episode.final[None] - offset),
        **{EPISODES + name: np.array([value]) for name, value in once.items()},
    }


def _bounded(task: Task, action: Array) -> Array:
    """Actions that only rounding to 32 bits took beyond a bound, on that bound."""
    inside = np.clip(action, *np.array((task.action_low, task.action_high), np.float32))
    rounded = np.abs(action - inside) <= np.spacing(np.abs(action))
    return np.where(rounded, inside, action)
