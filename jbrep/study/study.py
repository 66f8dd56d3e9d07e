"""A study from start to end, and an estimate of how long it takes."""

import textwrap
from collections import Counter
from contextlib import closing
from dataclasses import replace

from jbrep.encoders import FULL
from jbrep.encoders.code import is_code
from jbrep.files.lock import exclusive
from jbrep.rl import Run
from jbrep.rl.run import read_result
from jbrep.rl.speed import estimate
from jbrep.study.plan import Cell, Plan
from jbrep.study.prepare import check, prepare
from jbrep.study.progress import Progress, duration
from jbrep.study.representations import ByCode
from jbrep.study.runner import Backend
from jbrep.study.work import CRASHED
from jbrep.text import table


def run_study(plan: Plan, backend: Backend, workers: int) -> int:
    """Collect data, train encoders, and train every agent that hasn't been trained yet.

    `jbrep.study.results.conclude` then writes what came of it.

    Returns:
        How many runs crashed.

    Raises:
        InputError: the folder holds another study, or the study's settings can't be used.
    """
    check(plan)
    plan.write()
    with exclusive(plan.folder):
        prepare(plan)
        unfinished = plan.unfinished
        for cell in plan.cells:  # so that any mistake shows before the first run
            read_result(plan.run(cell), plan.folder_of(cell))
        if not unfinished:
            return 0
        statuses = Counter[str]()
        with (
            Progress(plan, unfinished) as progress,
            closing(backend(plan, unfinished, workers)) as outcomes,
        ):
            for outcome in outcomes:
                progress.report(outcome)
                statuses[outcome.status] += 1
    return statuses[CRASHED]


def dry_run(plan: Plan, workers: int, width: int | None = None) -> str:
    """The runs to go, and how long they would take, estimated from a few steps of each learner.

    Args:
        plan: the study.
        workers: how many runs would go on at a time.
        width: to fit [columns]; None for no limit.

    Raises:
        InputError: as `run_study`, as far as that is known beforehand.
    """
    check(plan)
    unfinished = plan.unfinished
    examples = {_kind(cell): cell for cell in unfinished}
    seconds = {kind: estimate(_example(plan.run(cell))) for kind, cell in examples.items()}
    rows = [(cell.name, duration(seconds[_kind(cell)])) for cell in unfinished]
    total = sum(seconds[_kind(cell)] for cell in unfinished)
    done = len(plan.cells) - len(unfinished)
    summary = (
        f"{len(unfinished)} runs to go, {done} done; {duration(total)} on one core, "
        f"{duration(total / workers)} with {workers} workers, besides data and encoders"
    )
    told = textwrap.fill(summary, width) if width else summary
    return f"{table(('run', 'time'), rows, width)}\n\n{told}" if rows else told


def _kind(cell: Cell) -> tuple[str, str, str]:
    """What the duration of a run depends on."""
    own = cell.representation.name if isinstance(cell.representation, ByCode) else ""
    return cell.task, cell.learner.name, own


def _example(run: Run) -> Run:
    """A run that takes as long; an encoder that is no code need not exist yet, and costs little."""
    return run if is_code(run.encoder) else replace(run, encoder=FULL)
