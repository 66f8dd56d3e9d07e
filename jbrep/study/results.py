"""A study's runs as one table, and what the statistics say of them."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jbrep.dataset.storage import write_whole
from jbrep.errors import InputError
from jbrep.rl.files import FAILED, RUN, read_evaluations, read_run, write_csv
from jbrep.stats import Analysis, RunCurve, analyse, summary
from jbrep.tables import table

RETURNS = "returns.csv"
STATISTICS = "statistics.json"
_COLUMNS = ("task", "algorithm", "representation", "seed", "step", "episode", "return")


def read_runs(folder: Path) -> list[RunCurve]:
    """The runs below a folder that are over.

    Raises:
        InputError: there is none, or a file of one is damaged.
    """
    files = sorted(folder.rglob(RUN))
    if not files:
        raise InputError(f"no run that is over below {folder}: jbrep study or jbrep rl makes one")
    return [_curve(file.parent) for file in files]


def _curve(folder: Path) -> RunCurve:
    run = read_run(folder)
    try:
        return _as_curve(run, folder)
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{folder / RUN} is damaged, or not of a run") from None


def _as_curve(run: dict[str, Any], folder: Path) -> RunCurve:
    settings = dict(run["settings"])
    seed = settings.pop("seed")
    preset = settings["preset"]
    suffix = "" if preset == "paper" else f"-{preset}"
    evaluations = read_evaluations(folder)
    steps = sorted({each.step for each in evaluations})
    returns = [[e.episode_return for e in evaluations if e.step == step] for step in steps]
    return RunCurve(
        task=settings["task"],
        algorithm=settings["algorithm"] + suffix,
        representation=settings["representation"],
        seed=seed,
        settings=hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8],
        steps=np.array(steps, dtype=np.int64),
        returns=np.array(returns, dtype=np.float64),
        total_steps=max(run["steps"], settings["steps"]),
        failed_at=run["steps"] if run["status"] == FAILED else None,
    )


class Results(NamedTuple):
    """What a folder of runs says."""

    runs: list[RunCurve]
    analysis: Analysis | None
    refusal: str  # why there are no statistics


def read_results(folder: Path) -> Results:
    """The runs below a folder, and their statistics where they allow any.

    Raises:
        InputError: no run is over there, or a file is damaged.
    """
    runs = read_runs(folder)
    try:
        return Results(runs, analyse(runs), "")
    except InputError as error:
        return Results(runs, None, str(error))


def write_results(results: Results, folder: Path) -> list[Path]:
    """Write all returns as one long table, and the statistics if there are any."""
    paths = [folder / RETURNS]
    write_csv(paths[0], _COLUMNS, _rows(results.runs))
    if results.analysis:
        paths.append(folder / STATISTICS)
        write_whole(paths[1], results.analysis.to_json().encode())
    return paths


def as_text(results: Results) -> str:
    """Tables to read: the statistics, or each run's end where there are none."""
    if results.analysis is None:
        return f"{table(*_ends(results.runs))}\n\nno statistics: {results.refusal}"
    return summary(results.analysis)


def _rows(runs: list[RunCurve]) -> Iterator[tuple[Any, ...]]:
    for run in sorted(runs, key=lambda run: (run.label, run.seed)):
        for step, returns in zip(run.steps.tolist(), run.returns.tolist(), strict=True):
            for episode, each in enumerate(returns):
                key = (run.task, run.algorithm, run.representation, run.seed)
                yield (*key, step, episode, f"{each:.3f}")


def _ends(runs: list[RunCurve]) -> tuple[tuple[str, ...], Iterator[tuple[str, ...]]]:
    """A line for each run: the returns of its last evaluation."""
    header = ("run", "seed", "steps", "median return", "10-90 %")

    def row(run: RunCurve) -> tuple[str, ...]:
        if run.failed_at is not None:
            return run.label, str(run.seed), f"{run.failed_at:,}", "failed", "-"
        low, median, high = np.percentile(run.returns[-1], (10, 50, 90))
        steps = f"{run.steps[-1]:,}"
        return run.label, str(run.seed), steps, f"{median:.0f}", f"[{low:.0f}, {high:.0f}]"

    return header, map(row, runs)
