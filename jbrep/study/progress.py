"""What a study looks like while it runs."""

import time
from collections import Counter
from collections.abc import Iterable

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from jbrep.rl.files import FAILED, FINISHED, read_run
from jbrep.study.plan import Cell, Plan
from jbrep.study.work import CRASHED, Outcome, read_progress


class Progress:
    """A live table: runs done, running, failed, and the time left.

    Args:
        plan: the study.
        left: the runs that aren't over.
    """

    def __init__(self, plan: Plan, left: Iterable[Cell]):
        self._plan = plan
        self._left = {cell.name: cell for cell in left}
        self._counts = Counter(
            read_run(plan.folder_of(cell))["status"]
            for cell in plan.cells
            if cell.name not in self._left
        )
        self._began, self._over = time.monotonic(), 0  # runs since then
        self._before = self._in_work()  # steps of earlier processes
        self._console = Console(stderr=True)
        self._live = Live(
            console=self._console, get_renderable=self._table, refresh_per_second=1, transient=True
        )

    def __enter__(self) -> "Progress":
        self._live.__enter__()
        return self

    def __exit__(self, *what: object) -> None:
        self._live.__exit__(None, None, None)

    def tell(self, outcome: Outcome) -> None:
        """A run is over."""
        self._counts[outcome.status] += 1
        self._over += 1
        total = len(self._plan.cells)
        del self._left[outcome.name]
        number = total - len(self._left)
        line = f"{number}/{total} {outcome.name} {outcome.status}: {outcome.words}"
        self._console.print(escape(line), highlight=False, soft_wrap=True)

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in ("running", "steps", "last evaluation"):
            table.add_column(name, justify="left" if name == "running" else "right")
        for cell in list(self._left.values()):
            step, mean = read_progress(self._plan.folder_of(cell))
            if step:
                table.add_row(cell.name, f"{step:,} of {self._plan.study.steps:,}", mean)
        table.caption = self._summary()
        return table

    def _summary(self) -> str:
        words = [f"{self._counts[status]} {status}" for status in (FINISHED, FAILED, CRASHED)]
        return ", ".join([*words, f"{len(self._left)} to go, {self._time_left()} left"])

    def _in_work(self) -> int:
        """Steps of the runs that are begun and not over."""
        return sum(read_progress(self._plan.folder_of(c))[0] for c in list(self._left.values()))

    def _time_left(self) -> str:
        """From the steps made since this began."""
        steps, in_work = self._plan.study.steps, self._in_work()
        done = self._over * steps + in_work - self._before
        if done <= 0:
            return "-"
        seconds = (time.monotonic() - self._began) / done * (len(self._left) * steps - in_work)
        return in_words(seconds)


def in_words(seconds: float) -> str:
    """A duration: 40 s, 7 min, 12.5 h."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"
