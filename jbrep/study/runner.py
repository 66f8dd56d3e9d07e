"""A study from start to end: its runs side by side, on this machine or on a Ray cluster."""

import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from jbrep.envs.names import imported_modules
from jbrep.machine import cores
from jbrep.pool import ATTEMPTS, Pool, on_cluster, stop_requested
from jbrep.records.storage import exclusive, exists, make_folder
from jbrep.rl.files import FAILED, FINISHED, read_run
from jbrep.rl.settings import CPU, CUDA
from jbrep.rl.training import drop_checkpoint, standing_of
from jbrep.study.plan import STUDY, Cell, Plan
from jbrep.study.prepare import check, policies, prepare
from jbrep.study.registration import (
    REGISTRATION,
    Registration,
    beside,
    find_committed,
    registration_in,
)
from jbrep.study.results import play_references
from jbrep.study.tables import REFERENCE_RETURNS
from jbrep.study.work import CRASHED, Outcome, read_progress, say, work
from jbrep.text import duration

_OWN = STUDY, REGISTRATION, REFERENCE_RETURNS, "data", "encoders", "runs"  # see `make_folder`

Backend = Callable[[Plan, Iterable[Cell], int], Generator[Outcome]]


def usual_workers(plan: Plan) -> int:
    """How many runs go on at a time: one for each core, or one that has a GPU and all cores."""
    return cores() if plan.device == CPU else 1


def on_this_machine(plan: Plan, cells: Iterable[Cell], workers: int) -> Generator[Outcome]:
    """Bring runs to their end in processes of one thread each; yield the outcomes as they come.

    A run whose worker is killed is resumed from its checkpoint by another, up to five times. Closed
    early, this waits until the runs under way have written their checkpoints.
    """
    waiting, deaths = deque(cells), Counter[str]()
    with Pool[Cell, Outcome | None](work, workers, _announce_stop) as pool:
        while waiting or not pool.is_idle:
            while waiting and not pool.is_full:
                cell = waiting.popleft()
                pool.submit(cell, *_job(plan, cell))
            cell, outcome = pool.result()
            if outcome is not None:
                yield outcome
                continue
            deaths[cell.name] += 1
            if deaths[cell.name] == ATTEMPTS:
                yield _killed(cell.name)
            else:
                waiting.append(cell)


def _announce_stop() -> None:
    say("stopping: the runs under way write their checkpoints; Ctrl-C again ends them at once")


def _killed(name: str) -> Outcome:
    reason = f"its worker was killed {ATTEMPTS} times, perhaps because memory ran out"
    return Outcome(name, CRASHED, f"{reason}: try fewer --workers")


def on_ray(plan: Plan, cells: Iterable[Cell], workers: int) -> Generator[Outcome]:
    """The same on the Ray cluster that RAY_ADDRESS names, or else on a local one.

    All nodes need the study's folder at the same path. The runs of a node that dies are resumed on
    another. Closed early, this cancels the runs under way; their checkpoints are up to a minute
    old.
    """
    import ray

    task = on_cluster(work, workers, gpus=int(plan.device == CUDA))
    under_way = {task.remote(*_job(plan, cell)): cell for cell in cells}
    try:
        while under_way:
            (done,), _ = ray.wait(list(under_way))
            cell = under_way.pop(done)
            try:
                yield ray.get(done)
            except ray.exceptions.WorkerCrashedError:
                yield _killed(cell.name)
            except ray.exceptions.RayError as error:
                reason = str(error).strip().rpartition("\n")[2]
                yield Outcome(cell.name, CRASHED, reason)
    finally:
        for job in under_way:
            ray.cancel(job, force=True)


BACKENDS: dict[str, Backend] = {"local": on_this_machine, "ray": on_ray}


def _job(plan: Plan, cell: Cell) -> tuple[Any, ...]:
    """The arguments of `work`."""
    return plan.assigned(cell), stop_requested, imported_modules()


def run_study(
    plan: Plan,
    backend: Backend = on_this_machine,
    workers: int | None = None,
) -> int:
    """Collect data, train encoders, and train every agent that hasn't been trained yet.

    A study with claims is registered first: beside its file, in a commit, where git has that file.

    At last the policies play that agents are compared with. `jbrep.study.results.write_tables` then
    writes what came of it.

    Args:
        plan: the study.
        backend: what runs it.
        workers: how many processes go on at a time; by default as many as are usual.

    Returns:
        How many runs crashed.
    """
    check(plan)
    workers, unfinished = workers or usual_workers(plan), plan.unfinished
    registered = find_committed(plan.file, plan.study) if plan.file else None
    make_folder(plan.folder, _OWN)
    with exclusive(plan.folder):
        plan.begin()
        if registered:
            plan.register(registered)
        elif plan.study.has_claims and not plan.has_begun:
            _register(plan)
        prepare(plan, workers)
        for cell in plan.cells:  # so that any mistake shows before the first run
            if standing_of(plan.run(cell), plan.folder_of(cell)).ended:
                drop_checkpoint(plan.folder_of(cell))  # it was killed at the very end
        plan.write()  # not before: a study that is refused changes nothing
        progress = Progress(plan, unfinished)
        if unfinished:
            with progress.live, closing(backend(plan, unfinished, workers)) as outcomes:
                for outcome in outcomes:
                    progress.report(outcome)
        play_references(plan)
    return progress.counts[CRASHED]


def register_study(plan: Plan) -> Path:
    """Write down what is going to be run: beside the study's file, or in its folder without one.

    What is registered already stays as it is.

    Returns:
        The registration's file.
    """
    check(plan)
    if plan.file is None:
        make_folder(plan.folder, _OWN)
        with exclusive(plan.folder):
            plan.begin()
            plan.write()
            if plan.registration is None:
                _register(plan)
        return plan.folder / REGISTRATION
    path = beside(plan.file)
    if not exists(path) or registration_in(path).registered != plan.study:
        plan.check_new()
        _registration(plan).write(path)
    return path


def _register(plan: Plan) -> None:
    plan.register(_registration(plan))


def _registration(plan: Plan) -> Registration:
    return Registration.of(
        plan.study,
        encoders=plan.fingerprints,
        policies=policies(plan),
        data=plan.existing_data,
        committed=plan.in_git,
    )


class Progress:
    """A line for each run that ends; on a terminal also a live table of the runs under way.

    Args:
        plan: the study.
        unfinished: the runs to go.

    Attributes:
        live: a context that shows the table.
        counts: how many runs have ended, by status.
    """

    def __init__(self, plan: Plan, unfinished: Iterable[Cell]):
        self._plan = plan
        self._unfinished = {cell.name: cell for cell in unfinished}
        self.counts = Counter[str](
            read_run(plan.folder_of(cell)).status
            for cell in plan.cells
            if cell.name not in self._unfinished
        )
        self._start, self._ended = time.monotonic(), 0  # runs that ended since then
        self._steps_before = self._steps_under_way()
        self.live: AbstractContextManager[object] = nullcontext()
        if sys.stderr is not None and sys.stderr.isatty():
            self.live = Live(
                console=Console(stderr=True),
                get_renderable=self._table,
                refresh_per_second=1,
                transient=True,
            )

    def report(self, outcome: Outcome) -> None:
        """Count a run that has ended, and print a line."""
        del self._unfinished[outcome.name]
        self.counts[outcome.status] += 1
        self._ended += 1
        total = len(self._plan.cells)
        number = total - len(self._unfinished)
        say(f"{number}/{total} {outcome.name} {outcome.status}: {outcome.message}")

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in ("running", "steps", "last evaluation"):
            table.add_column(name, justify="left" if name == "running" else "right")
        for cell in list(self._unfinished.values()):
            step, mean = read_progress(self._plan.folder_of(cell))
            last = mean if step < self._plan.study.steps else "final ones under way"
            if step:
                table.add_row(cell.name, f"{step:,} of {self._plan.study.steps:,}", last)
        table.caption = self._summary()
        return table

    def _summary(self) -> str:
        counts = [f"{self.counts[status]} {status}" for status in (FINISHED, FAILED, CRASHED)]
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
