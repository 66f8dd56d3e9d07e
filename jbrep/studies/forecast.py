"""What a study would do: the runs to go, each estimated from a short trial."""

import heapq
from collections.abc import Iterable
from typing import NamedTuple

from jbrep.encoders import FULL
from jbrep.envs.names import is_code
from jbrep.progress import Progress
from jbrep.rl import Run
from jbrep.rl.run import estimate
from jbrep.stats.power import Prospect, prospects
from jbrep.studies.plan import Cell, Plan
from jbrep.studies.prepare import check
from jbrep.studies.representations import ByCode
from jbrep.studies.runner import usual_workers


class Forecast(NamedTuple):
    """What a study would do, and how long its runs would take."""

    runs: list[tuple[Cell, float]]  # to go, each with its time [s]
    done: int
    elapsed: float  # with so many workers [s]
    workers: int
    prospects: list[Prospect]  # of its claims


def forecast(plan: Plan, workers: int | None = None) -> Forecast:
    """The runs to go, and how long they would take, estimated from a few steps of each learner."""
    check(plan)
    plan.check_folder()
    workers, cells = workers or usual_workers(plan), plan.unfinished
    examples = {_kind(cell): cell for cell in cells}
    seconds = {
        kind: estimate(_example(plan.run(cell)))
        for kind, cell in Progress(
            examples.items(), desc="timing", unit="trial", delay=1, leave=False
        )
    }
    each = [seconds[_kind(cell)] for cell in cells]
    return Forecast(
        runs=list(zip(cells, each, strict=True)),
        done=len(plan.cells) - len(cells),
        elapsed=until_done(each, workers),
        workers=workers,
        prospects=list(prospects(plan.study.planned, plan.study.units)),
    )


def until_done(durations: Iterable[float], workers: int) -> float:
    """When the last worker ends, if each takes the longest work that is left."""
    busy = [0.0] * workers
    for each in sorted(durations, reverse=True):
        heapq.heapreplace(busy, busy[0] + each)
    return max(busy)


def _kind(cell: Cell) -> tuple[object, ...]:
    """What the duration of a run depends on, whatever of its settings seeds draw."""
    own = cell.representation.name if isinstance(cell.representation, ByCode) else ""
    return cell.task, cell.learner.name, own


def _example(run: Run) -> Run:
    """A run that takes as long; an encoder that is no code need not exist yet, and costs little."""
    return run if is_code(run.encoder) else run.replace(encoder=FULL)
