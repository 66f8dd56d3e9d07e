"""Shares of episodes, such as of successes: numbers of `info` that are 0 or 1 in each of a task."""

from collections.abc import Mapping

import numpy as np

from jbrep.envs.infos import by_name, shares
from jbrep.report.tables import Tables
from jbrep.report.words import shown
from jbrep.rl.files import FAILED
from jbrep.stats.intervals import LEVEL, Bounds, mean_within, unless_few
from jbrep.study.tables import RunInfo, by_run, run_of

Cells = Mapping[str, Mapping[str, str]]  # by the column's head, then by label


def share_of(name: str) -> str:
    """The head of a column."""
    return f"share of {name}"


def shares_of_runs(tables: Tables) -> dict[tuple[str, int], dict[str, float]]:
    """Shares by name in the last evaluation of each run that finished, by its label and seed."""
    last = {run: max(returns) for run, returns in by_run(tables.returns).items()}
    by_task: dict[str, list[RunInfo]] = {}
    told: dict[tuple[str, int], list[RunInfo]] = {}
    for row in tables.infos:
        if row.step == last.get(run_of(row)):
            by_task.setdefault(row.task, []).append(row)
            told.setdefault(run_of(row), []).append(row)
    known = {task: shares(_by_name(rows)) for task, rows in by_task.items()}
    return {
        (run.label, run.seed): {
            name: float(np.mean(values))
            for name, values in _by_name(own).items()
            if name in known[own[0].task]
        }
        for run in tables.record.runs
        for own in [told.get((run.label, run.seed), [])]
        if run.status != FAILED
    }


def share_cells(tables: Tables) -> Cells:
    """For a column of each share, its mean over the runs of each label, with its interval."""
    values: dict[str, dict[str, list[float]]] = {}
    for (label, _), of_run in shares_of_runs(tables).items():
        for name, share in of_run.items():
            values.setdefault(share_of(name), {}).setdefault(label, []).append(share)
    return {
        head: {label: _cell(each) for label, each in by_label.items()}
        for head, by_label in values.items()
    }


def _cell(values: list[float]) -> str:
    found = mean_within(np.array(values), Bounds(0, 1), LEVEL)
    return shown(unless_few(found, len(values)), ".2f")


def _by_name(rows: list[RunInfo]) -> dict[str, list[float]]:
    return by_name({row.name: row.value} for row in rows)
