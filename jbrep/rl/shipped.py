"""The policies that ship: the best agent that was trained for each of the Jitterbug's tasks."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.envs.task import Array, Task
from jbrep.errors import DamageError, InputError
from jbrep.records import container
from jbrep.records.document import document_from
from jbrep.records.storage import exists
from jbrep.records.tables import Columns, count, finite, read_csv
from jbrep.rl.files import POLICY_SUFFIX, PolicyHeader

SHIPPED = "trained"  # what commands call the one that ships for their task
FOLDER = Path(__file__).parent / "shipped"
RETURNS = "returns.csv"  # of the policies that ship, and of others
COLUMNS: Columns = {"task": str, "policy": str, "episode": count, "return": finite}

Returns = Mapping[str, Array]  # by policy, in the first episodes that every run is evaluated on


class Shipped(NamedTuple):
    """A policy that ships."""

    task: str
    observes: str  # as tables call it
    learner: str
    steps: int  # of training
    returns: Returns  # of this policy, SHIPPED, and of others by their names


def file_of(task: str) -> Path:
    """Where the policy for a task is, if one ships."""
    return FOLDER / f"{task}{POLICY_SUFFIX}"


def find(task: Task) -> Path:
    """The file of the policy that ships for a task, whatever its time limit and body."""
    path = file_of(task.slug)
    if not exists(path):
        ships = ", ".join(sorted(each.stem for each in FOLDER.glob(f"*{POLICY_SUFFIX}")))
        raise InputError(f"no {SHIPPED} policy ships for {task.name}: only for {ships}")
    return path


def shipped() -> list[Shipped]:
    """All policies that ship, with what they return.

    Raises:
        DamageError: a file that ships isn't what was written.
    """
    found = []
    for task, returns in _read_returns().items():
        path = file_of(task)
        header = document_from(container.read(path, "policy")[1], path, PolicyHeader)
        names = (header.settings.representation, header.settings.learner)
        found.append(Shipped(task, *names, header.step, returns))
    return found


def _read_returns() -> dict[str, Returns]:
    path = FOLDER / RETURNS
    try:
        rows = read_csv(path, COLUMNS)
    except InputError as error:
        raise DamageError(f"{path} is damaged: install jbrep again") from error
    found: dict[str, dict[str, list[float]]] = {}
    for task, policy, _, value in rows:
        found.setdefault(task, {}).setdefault(policy, []).append(value)
    return {
        task: {policy: np.array(values) for policy, values in returns.items()}
        for task, returns in found.items()
    }
