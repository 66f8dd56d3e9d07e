"""A study from beginning to end, and what it would be."""

from collections import Counter
from dataclasses import replace

from jbrep.files.lock import exclusive
from jbrep.rl import train
from jbrep.rl.speed import estimate
from jbrep.study.plan import Cell, Plan
from jbrep.study.prepare import check, prepare
from jbrep.study.progress import Progress, in_words
from jbrep.study.runner import Backend
from jbrep.study.work import CRASHED


def run_study(plan: Plan, backend: Backend, workers: int) -> int:
    """Prepare a study and bring all its runs to their end; how many crashed.

    Raises:
        InputError: the folder is of another study, or what it needs can't be made.
    """
    check(plan)
    plan.begin()
    with exclusive(plan.folder):
        prepare(plan)
        left = [cell for cell in plan.cells if not plan.is_over(cell)]
        for cell in plan.cells:  # all that is wrong before the first hour
            if plan.is_over(cell):
                train(plan.run(cell), plan.folder_of(cell))  # makes sure that it is this very run
            else:
                plan.run(cell).check()
        if not left:
            return 0
        outcomes = Counter[str]()
        with Progress(plan, left) as progress:
            for outcome in backend(plan, left, workers):
                progress.tell(outcome)
                outcomes[outcome.status] += 1
    return outcomes[CRASHED]


def dry_run(plan: Plan, workers: int) -> str:
    """The runs that are left, and the time that they would take, from a short try of each kind.

    Raises:
        InputError: an encoder that is neither made by the study nor ships.
    """
    check(plan)
    left = [cell for cell in plan.cells if not plan.is_over(cell)]
    kinds = {(cell.task, cell.learner.name): cell for cell in left}
    seconds = {  # whatever the encoder, which may not be there yet
        kind: estimate(replace(plan.run(cell), encoder="identity")) for kind, cell in kinds.items()
    }
    lines = [f"{cell.name}  {in_words(seconds[_kind(cell)])}" for cell in left]
    total = sum(seconds[_kind(cell)] for cell in left)
    over = len(plan.cells) - len(left)
    lines.append(
        f"{len(left)} runs to go, {over} over; {in_words(total)} of one core, "
        f"{in_words(total / workers)} with {workers} workers, data and encoders aside"
    )
    return "\n".join(lines)


def _kind(cell: Cell) -> tuple[str, str]:
    return cell.task, cell.learner.name
