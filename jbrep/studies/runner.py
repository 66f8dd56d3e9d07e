"""A study from start to end: its runs side by side, on this machine or on a Ray cluster."""

import time
import traceback
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

from jbrep.envs.names import Known
from jbrep.errors import first_line
from jbrep.machine import cores
from jbrep.pool import KILLED, on_cluster, side_by_side, stop_requested
from jbrep.records.storage import exclusive, exists, make_folder, write_note
from jbrep.rl import Session, StoppedError, train
from jbrep.rl.files import runs_below
from jbrep.rl.history import History
from jbrep.rl.training import drop_checkpoint, standing_of
from jbrep.studies.plan import (
    PROGRESS,
    REGISTRATION,
    STUDY,
    Assigned,
    Cell,
    Plan,
    beside,
    find_committed,
    registration_in,
)
from jbrep.studies.prepare import EVALUATIONS, check, policies, prepare, say
from jbrep.studies.tables import REFERENCE_RETURNS, play_references, write_tables, writing

ERROR = "error.txt"  # the traceback of a run that crashed
CRASHED = "crashed"
# see `make_folder`
_OWN = STUDY, REGISTRATION, REFERENCE_RETURNS, "data", "encoders", EVALUATIONS, "runs"
_PATIENCE = 60.0  # seconds, until runs have written their checkpoints
_WRITE_EVERY = 1.0  # seconds
_TELL_EVERY = 30.0  # seconds


class RunOutcome(NamedTuple):
    """How a run ended."""

    name: str
    status: str  # finished, failed or crashed
    message: str  # the reason, or how long it took


def work(assigned: Assigned, known: Known | None = None) -> RunOutcome | None:
    """Train a run; an error is reported in its outcome and stops no other run.

    Args:
        assigned: the run.
        known: what a process of its own imports and registers first.

    Returns:
        How the run ended; None if it was stopped.
    """
    try:
        make_folder(assigned.folder)
        if known:
            known.take()
        watch = _Progress(assigned)
        result = train(assigned.run, assigned.folder, Session(watch, stop=stop_requested))
    except StoppedError:
        return None
    except Exception as error:
        path = assigned.folder / ERROR
        write_note(path, "".join(traceback.format_exception(error)))
        return RunOutcome(assigned.name, CRASHED, f"{first_line(error)}; see {path}")
    for leftover in (PROGRESS, ERROR):
        (assigned.folder / leftover).unlink(missing_ok=True)
    message = result.reason or f"{result.seconds / 60:.1f} min"
    return RunOutcome(assigned.name, result.status, message)


class _Progress:
    """Tells the parent process, through a file, how far a run is, and now and then a reader."""

    def __init__(self, assigned: Assigned) -> None:
        self._path, self._steps = assigned.folder / PROGRESS, assigned.run.steps
        self._name, self._written, self._reported = assigned.name, 0.0, (time.monotonic(), 0)

    def __call__(self, history: History, step: int) -> None:
        now = time.monotonic()
        before, first = self._reported
        if now - before >= _TELL_EVERY:
            rate = f", {(step - first) / (now - before):,.0f} a second" if first else ""
            last = history.last_mean
            mean = "" if last is None else f", mean return {last:.4g}"
            say(f"{self._name}: {step:,} of {self._steps:,} steps{rate}{mean}")
            self._reported = now, step
        if step >= self._steps or now - self._written >= _WRITE_EVERY:
            write_note(self._path, str(step))
            self._written = now


Backend = Callable[[Plan, Iterable[Cell], int], Generator[RunOutcome]]


def usual_workers(plan: Plan) -> int:
    """How many runs go on at a time: one for each core, or one that has a GPU and all cores."""
    return cores() if plan.device == "cpu" else 1


def on_this_machine(plan: Plan, cells: Iterable[Cell], workers: int) -> Generator[RunOutcome]:
    """Bring runs to their end in processes of one thread each; yield the outcomes as they come.

    A run whose worker is killed is resumed from its checkpoint by another, up to five times. Closed
    early, this waits until the runs under way have written their checkpoints.
    """
    jobs = map(plan.assigned, cells)
    train = partial(work, known=plan.known)
    on_stop = partial(
        say, "stopping: the runs under way write their checkpoints; Ctrl-C again ends all"
    )
    ended = side_by_side(train, lambda: next(jobs, None), workers, _PATIENCE, on_stop)
    with closing(ended):
        for job, outcome in ended:
            yield outcome or _killed(job.name)


def _killed(name: str) -> RunOutcome:
    return RunOutcome(name, CRASHED, f"its worker {KILLED} `workers`")


def on_ray(plan: Plan, cells: Iterable[Cell], workers: int) -> Generator[RunOutcome]:
    """The same on the Ray cluster that RAY_ADDRESS names, or else on a local one.

    All nodes need the study's folder at the same path. The runs of a node that dies are resumed on
    another. Closed early, this cancels the runs under way; their checkpoints are up to a minute
    old.
    """
    import ray

    task = on_cluster(work, workers, gpus=int(plan.device == "cuda"))
    known = plan.known
    under_way = {task.remote(plan.assigned(cell), known): cell for cell in cells}
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
                yield RunOutcome(cell.name, CRASHED, reason)
    finally:
        for job in under_way:
            ray.cancel(job, force=True)


BACKENDS: dict[str, Backend] = {"local": on_this_machine, "ray": on_ray}


def run_study(plan: Plan, backend: Backend = on_this_machine, workers: int | None = None) -> int:
    """Collect data, train encoders, and train every agent that hasn't been trained yet.

    A study with claims is registered first: beside its file, in a commit, where git has that file.
    At last the policies play that agents are compared with.

    Returns:
        How many runs crashed.
    """
    check(plan)
    workers, unfinished = workers or usual_workers(plan), plan.unfinished
    registered = find_committed(plan.file, plan.study) if plan.file else None
    make_folder(plan.folder, _OWN)
    with exclusive(plan.folder):
        plan.check_folder()
        if not exists(plan.folder / STUDY):
            plan.write()
        if registered:
            plan.register(registered)
        elif plan.study.verdicts.claims and not (plan.registration or plan.has_begun):
            plan.register(plan.to_register(policies(plan)))
        prepare(plan, workers)
        for cell in plan.cells:  # so that any mistake shows before the first run
            if standing_of(plan.run(cell), plan.folder_of(cell)).ended:
                drop_checkpoint(plan.folder_of(cell))  # it was killed at the very end
        plan.write()  # not before: a study that is refused changes nothing
        crashed, done = 0, len(plan.cells) - len(unfinished)
        if unfinished:
            with closing(backend(plan, unfinished, workers)) as outcomes:
                for number, each in enumerate(outcomes, done + 1):
                    say(f"{number}/{len(plan.cells)} {each.name} {each.status}: {each.message}")
                    crashed += each.status == CRASHED
        if runs_below(plan.folder):
            with writing(plan.folder):
                write_tables(plan.folder)
            play_references(plan.folder)
    return crashed


def register_study(plan: Plan) -> Path:
    """Write down what is going to be run: beside the study's file, or in its folder without one.

    What is registered already stays as it is. Returns the registration's file.
    """
    check(plan)
    if plan.file is None:
        make_folder(plan.folder, _OWN)
        with exclusive(plan.folder):
            plan.write()
            if plan.registration is None:
                plan.register(plan.to_register(policies(plan)))
        return plan.folder / REGISTRATION
    path = beside(plan.file)
    if not exists(path) or registration_in(path).registered != plan.study:
        plan.check_new()
        plan.to_register(policies(plan)).write(path)
    return path
