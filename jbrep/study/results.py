"""The runs of a study as tables, and what the statistics say of them."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.record import to_plain
from jbrep.records.storage import exists, write_whole
from jbrep.records.tables import Columns, count, finite, write_csv
from jbrep.rl.files import RUN, read_evaluations, read_run, runs_below
from jbrep.rl.record import FAILED, RunRecord
from jbrep.stats import Analysis, RunCurve, analyse, statistics_text
from jbrep.stats.rules import Planned
from jbrep.stats.scale import STILL
from jbrep.study.plan import STUDY, read_plan
from jbrep.study.record import RECORD, runs_record, shared_settings
from jbrep.study.references import References, read_references, write_references
from jbrep.text import rounded, table

RETURNS = "returns.csv"
STATISTICS = "statistics.json"
Ended = dict[Path, RunRecord]  # what run.json says of each run that has ended, by folder
COLUMNS: Columns = {  # of the long table of returns
    **{"task": str, "algorithm": str, "representation": str},
    **{"seed": count, "step": count, "episode": count, "return": finite},
}


class Results(NamedTuple):
    """The runs in a folder, and what the statistics say of them."""

    ended: Ended
    runs: list[RunCurve]
    analysis: Analysis | None
    left_out: list[str]  # what there are no statistics of, and why


def conclude(folder: Path, across_trainers: bool = False) -> tuple[Results, list[Path]]:
    """Write the tables of the runs below a folder, of a study or not, as far as they have ended.

    Args:
        folder: with the runs.
        across_trainers: compare runs of different trainers, too.

    Returns:
        The results and the files: every return, what was run, the statistics if there are any, and
        the returns of reference policies.

    Raises:
        InputError: as `read_results` and `write_results`.
    """
    ended = _ended(folder)
    references = write_references(_tasks(ended.values()), folder)
    results = _results(folder, ended, across_trainers)
    paths = write_results(results, folder)
    return results, [*paths, references] if references else paths


def read_results(folder: Path, across_trainers: bool = False) -> Results:
    """The runs below a folder that have finished or failed, with statistics if they allow any.

    Args:
        folder: with the runs.
        across_trainers: compare runs of different trainers, too.

    Raises:
        InputError: there is no such run, or a file is damaged.
    """
    return _results(folder, _ended(folder), across_trainers)


def _results(folder: Path, ended: Ended, across_trainers: bool) -> Results:
    plan, references = read_plan(folder), read_references(folder)
    runs = [_curve(*each, references, across_trainers) for each in ended.items()]
    compared, left_out = _comparable(runs)
    judge = plan.judge if plan else Planned()
    try:
        analysis = analyse(compared, judge, references=references) if compared else None
        return Results(ended, runs, analysis, left_out)
    except InputError as error:
        return Results(ended, runs, None, [*left_out, str(error)])


def read_runs(folder: Path) -> list[RunCurve]:
    """The runs below a folder that have finished or failed.

    Raises:
        InputError: there is none, or a file of one is damaged.
    """
    references = read_references(folder)
    return [_curve(*each, references) for each in _ended(folder).items()]


def has_runs(folder: Path) -> bool:
    """Whether a folder is of a study, or there is a run below it that has finished or failed."""
    return exists(folder / STUDY) or any(folder.rglob(RUN))


def _ended(folder: Path) -> Ended:
    folders = runs_below(folder)
    if not folders:
        resumed = exists(folder / STUDY)
        what_to_do = (
            "jbrep study resumes it" if resumed else "train one with jbrep rl or jbrep study"
        )
        raise InputError(f"no finished run below {folder}: {what_to_do}")
    return {each: read_run(each) for each in folders}


def _comparable(runs: list[RunCurve]) -> tuple[list[RunCurve], list[str]]:
    """The runs that there can be statistics of, though others are missing; what is left out."""
    counts = Counter((run.task, run.algorithm, run.representation) for run in runs)
    alone = {
        key: f"{'/'.join(key)}: one run has ended, at least two are needed"
        for key, count in counts.items()
        if count == 1
    }
    alone |= {
        key: f"{'/'.join(key)}: at least two runs of {FULL} are needed to compare it with"
        for key in counts
        if counts[*key[:2], FULL] < 2 and key not in alone
    }
    kept = [run for run in runs if (run.task, run.algorithm, run.representation) not in alone]
    return kept, sorted(alone.values())


def _tasks(runs: Iterable[RunRecord]) -> Iterable[tuple[Task, int]]:
    """The tasks of runs, with the most episodes that one was evaluated on at its end."""
    tasks: dict[str, tuple[Task, int]] = {}
    for run in runs:
        task, episodes = run.settings.environment, run.settings.final_episodes
        _, most = tasks.get(task.name, (task, 0))
        tasks[task.name] = task, max(most, episodes)
    return tasks.values()


def _curve(
    folder: Path, run: RunRecord, references: References, across_trainers: bool = False
) -> RunCurve:
    task, settings = run.settings.environment, to_plain(shared_settings(run.settings))
    trainer = [settings.pop(name) for name in ("trainer", "precision", "device")]
    evaluations = read_evaluations(folder)
    steps = sorted({each.step for each in evaluations})
    returns = [[e.episode_return for e in evaluations if e.step == step] for step in steps]
    still = references.get(task.name, {}).get(STILL)
    episodes = min(map(len, returns), default=0)  # the last evaluation may have more
    return RunCurve(
        task=task.name,
        algorithm=run.settings.learner,
        representation=run.settings.representation,
        seed=run.settings.seed,
        settings=hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8],
        steps=np.array(steps, dtype=np.int64),
        returns=np.array([each[:episodes] for each in returns], dtype=np.float64),
        total_steps=max(run.steps, run.settings.steps),
        failed_at=run.steps if run.status == FAILED else None,
        return_floor=task.return_floor,
        return_ceiling=task.return_ceiling,
        still=float(np.mean(still)) if still else None,
        solved=task.solved_return,
        trainer="" if across_trainers else " ".join(trainer),
        final=np.array(returns[-1]) if returns and len(returns[-1]) > episodes else None,
        encoder_seed=run.settings.encoder_seed,
    )


def write_results(results: Results, folder: Path) -> list[Path]:
    """Write all returns as one long table, what was run, and the statistics if there are any.

    Raises:
        InputError: a file of a run is damaged, or a table can't be written.
    """
    record = runs_record(folder, results.ended, results.left_out)
    paths = [folder / RETURNS, folder / RECORD]
    write_csv(paths[0], [*COLUMNS], _rows(results.runs))
    record.write(paths[1])
    if results.analysis:
        paths.append(folder / STATISTICS)
        write_whole(paths[2], results.analysis.to_json().encode())
    else:
        (folder / STATISTICS).unlink(missing_ok=True)  # of fewer runs
    return paths


def as_text(results: Results, width: int | None = None) -> str:
    """Tables to read: the statistics, or each run's last evaluation where there are none.

    Args:
        results: of the runs below a folder.
        width: to fit [columns]; None for no limit.
    """
    shown = (
        statistics_text(results.analysis, width)
        if results.analysis
        else table(*_last_evaluations(results.runs), width)
    )
    return "\n".join((shown, *(f"\nno statistics: {line}" for line in results.left_out)))


def _rows(runs: list[RunCurve]) -> Iterator[tuple[Any, ...]]:
    for run in sorted(runs, key=lambda run: (run.label, run.seed)):
        for step, returns in zip(run.steps.tolist(), run.evaluations, strict=True):
            for episode, each in enumerate(returns.tolist()):
                key = (run.task, run.algorithm, run.representation, run.seed)
                yield (*key, step, episode, f"{each:.3f}")


def _last_evaluations(runs: list[RunCurve]) -> tuple[tuple[str, ...], Iterator[tuple[str, ...]]]:
    """A row for each run."""
    header = ("run", "seed", "steps", "median return", "10-90 %")

    def row(run: RunCurve) -> tuple[str, ...]:
        if run.failed_at is not None:
            return run.label, str(run.seed), f"{run.failed_at:,}", "failed", "-"
        low, median, high = np.percentile(run.evaluations[-1], (10, 50, 90))
        steps = f"{run.steps[-1]:,}"
        at_low, at_median, at_high = rounded(low, median, high)
        return run.label, str(run.seed), steps, at_median, f"[{at_low}, {at_high}]"

    return header, map(row, runs)
