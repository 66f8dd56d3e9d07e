"""Data sets of what Python holds, or of others' files; each is written whole or not at all."""

from pathlib import Path
from typing import Any

from jbrep.dataset.formats import open_sources
from jbrep.dataset.formats.arrays import frame_in_python
from jbrep.dataset.formats.frame import frame_of_table
from jbrep.dataset.formats.source import Source
from jbrep.dataset.formats.writer import write
from jbrep.dataset.layout import Layout
from jbrep.dataset.reader import Dataset
from jbrep.envs.description import as_task
from jbrep.envs.names import is_code
from jbrep.envs.task import Task


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
    return _written(folder, Source(frame_in_python(columns, once, source)), task)


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
    opened = Source(frame_of_table(table, source), layout, missing)
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
        layout: as `from_table` takes it, like missing.
        missing: likewise.
        task: likewise; by default the one that the files name, if they do.
    """
    opened = open_sources([*map(str, (file, *more))], layout, missing)
    return _written(folder, opened, task, layout, missing)


def _written(
    folder: str | Path,
    source: Source,
    task: Task | str | None,
    layout: Layout | None = None,
    missing: str = "",
) -> Dataset:
    reward = layout.reward if layout and is_code(layout.reward) else ""
    known = None if task is None else as_task(task)
    write(source, Path(folder), known, missing=missing, reward=reward)
    return Dataset(folder)
