"""Returns of policies that learn nothing, on the starts of evaluation: what learning is held to."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.play.sources import find_player
from jbrep.records.storage import exists
from jbrep.records.tables import Columns, count, finite, read_csv, write_csv
from jbrep.stats.scale import STILL

REFERENCE_RETURNS = "references.csv"
RANDOM, HAND_WRITTEN = "random", "hand-written"
_POLICIES = {STILL: "still", RANDOM: "uniform", HAND_WRITTEN: "heuristic"}
_COLUMNS: Columns = {"task": str, "policy": str, "episode": count, "return": finite}
_Row = tuple[Any, ...]  # task, policy, episode, return
References = dict[str, dict[str, list[float]]]  # returns by task and policy


def write_references(tasks: Iterable[tuple[Task, int]], folder: Path) -> Path | None:
    """Play the reference policies of tasks: standing still, random, and hand-written if there is.

    What the file has already isn't played again; nor is a task whose environment is missing.

    Args:
        tasks: each with its number of episodes.
        folder: for the file.

    Returns:
        The file; None if there is nothing to write.

    Raises:
        DamageError: what is there isn't such a file.
    """
    path = folder / REFERENCE_RETURNS
    there = _rows(path)
    rows = [
        row
        for task, episodes in sorted(tasks, key=lambda each: each[0].name)
        for policy in _POLICIES
        if policy != HAND_WRITTEN or task.name in HEURISTICS
        for row in _kept(there, task, policy, episodes) or _played(task, policy, episodes)
    ]
    if not rows:
        path.unlink(missing_ok=True)
        return None
    if rows != there:
        write_csv(path, [*_COLUMNS], rows)
    return path


def read_references(folder: Path) -> References:
    """What `write_references` wrote; nothing if there is no such file.

    Raises:
        DamageError: it isn't what was written.
    """
    found: References = {}
    for task, policy, _, each in _rows(folder / REFERENCE_RETURNS):
        found.setdefault(task, {}).setdefault(policy, []).append(each)
    return found


def _rows(path: Path) -> list[_Row]:
    """What the file has; nothing if there is none."""
    return read_csv(path, _COLUMNS) if exists(path) else []


def _kept(there: list[_Row], task: Task, policy: str, episodes: int) -> list[_Row]:
    """The rows of a task and policy, if they are those wanted."""
    own = [row for row in there if row[:2] == (task.name, policy)]
    return own if [row[2] for row in own] == [*range(episodes)] else []


def _played(task: Task, policy: str, episodes: int) -> list[_Row]:
    try:
        returns = find_player(_POLICIES[policy], task).returns(episodes)
    except (InputError, ModuleNotFoundError):  # reports don't need the environments
        return []
    return [(task.name, policy, i, round(float(each), 3)) for i, each in enumerate(returns)]
