"""What a study shows while it runs."""

import sys
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext, suppress

from rich.console import Console
from rich.live import Live
from rich.table import Table

from jbrep.rl.files import FAILED, FINISHED, read_run
from jbrep.study.plan import Cell, Plan
from jbrep.study.work import CRASHED, Outcome, read_progress


class Progress:
    """A line for each run that ends; on a terminal also a live table of the runs under way.

    Args:
        plan: the study.
        unfinished: the runs to go.
    """

    def __init__(self, plan: Plan, unfinished: Iterable[Cell]):
        self._plan = plan
        self._unfinished = {cell.name: cell for cell in unfinished}
        self._counts = Counter[str](
            read_run(plan.folder_of(cell)).status
            for cell in plan.cells
            if cell.name not in self._unfinished
        )
        self._start, self._ended = time.monotonic(), 0  # runs that ended since then
        self._steps_before = self._steps_under_way()
        self._live: AbstractContextManager[object] = nullcontext()
        if sys.stderr is not None and sys.stderr.isatty():
            self._live = Live(
                console=Console(stderr=True),
                get_renderable=self._table,
                refresh_per_second=1,
                transient=True,
            )

    def __enter__(self) -> "Progress":
        self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.__exit__(None, None, None)

    def report(self, outcome: Outcome) -> None:
        """Count a run that has ended, and print a line."""
        self._counts[outcome.status] += 1
        self._ended += 1
        total = len(self._plan.cells)
        del self._unfinished[outcome.name]
        number = total - len(self._unfinished)
        say(f"{number}/{total} {outcome.name} {outcome.status}: {outcome.message}")

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in ("running", "steps", "last evaluation"):
            table.add_column(name, justify="left" if name == "running" else "right")
        for cell in list(self._unfinished.values()):
            step, mean = read_progress(self._plan.folder_of(cell))
            last = mean if step < self._plan.study.steps else "final one under way"
            if step:
                table.add_row(cell.name, f"{step:,} of {self._plan.study.steps:,}", last)
        table.caption = self._summary()
        return table

    def _summary(self) -> str:
        counts = [f"{self._counts[status]} {status}" for status in (FINISHED, FAILED, CRASHED)]
        return ", ".join([*counts, f"{len(self._unfinished)} to go, {self._time_left()} left"])

    def _steps_under_way(self) -> int:
        """Steps that the unfinished runs have done."""
        cells = list(self._unfinished.values())
        return sum(read_progress(self._plan.folder_of(cell))[0] for cell in cells)

    def _time_left(self) -> str:
        """From the steps done since the start."""
        steps, under_way = self._plan.study.steps, self._steps_under_way()
        done = self._ended * steps + under_way - self._steps_before
        if done <= 0:
            return "-"
        seconds_per_step = (time.monotonic() - self._start) / done
        return duration(seconds_per_step * (len(self._unfinished) * steps - under_way))


def say(line: str) -> None:
    """Print a line on standard error, above a live table; a study goes on where that fails."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """A duration as text: 40 s, 7 min, 12.5 h."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"
