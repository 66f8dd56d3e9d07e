"""Runs of a study, in a process of their own."""

import sys
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from jbrep.envs.names import import_modules
from jbrep.errors import InputError, first_line
from jbrep.records.storage import make_folder, read_file, write_note
from jbrep.rl import Run, StoppedError
from jbrep.rl.files import RunRecord
from jbrep.rl.job import Job, Session
from jbrep.rl.trainers import train_jobs
from jbrep.text import rounded

PROGRESS = "progress"
ERROR = "error.txt"  # the traceback of a run that crashed
CRASHED = "crashed"
_WRITE_EVERY = 1.0  # seconds
_MOST_PROGRESS = 1000  # bytes


class Outcome(NamedTuple):
    """How a run ended."""

    name: str
    status: str  # finished, failed or crashed
    message: str  # the reason, or how long it took


class Assigned(NamedTuple):
    """A run for a worker."""

    name: str
    run: Run
    folder: Path  # of this run alone


def work(
    assigned: Sequence[Assigned],
    stop: Callable[[], bool] = lambda: False,
    modules: Iterable[str] = (),
) -> list[Outcome] | None:
    """Train runs; an error is reported in the outcome of its run and stops no other.

    Args:
        assigned: the runs, which go on together where they can.
        stop: whether to write checkpoints and stop now.
        modules: to import first, as they register environments.

    Returns:
        How each run ended; None if they were stopped.
    """
    try:
        for each in assigned:
            make_folder(each.folder)
        import_modules(modules)
        jobs = [Job(each.run, each.folder) for each in assigned]
        session = Session(_ProgressFiles(assigned[0].run.steps), stop=stop)
        results = {job.folder: result for job, result in train_jobs(jobs, session)}
    except StoppedError:
        return None
    except Exception as error:
        if len(assigned) == 1:
            return [_crashed(assigned[0], error)]
    else:
        return [_ended(each, results[each.folder]) for each in assigned]
    # Now that the error, which held all that they had learned with, is gone: whose was it?
    alone = [work([each], stop, modules) for each in assigned]
    return None if None in alone else [outcome for each in alone for outcome in each or ()]


def _ended(assigned: Assigned, result: RunRecord) -> Outcome:
    for leftover in (PROGRESS, ERROR):
        (assigned.folder / leftover).unlink(missing_ok=True)
    message = result.reason or f"{result.seconds / 60:.1f} min"
    return Outcome(assigned.name, result.status, message)


def _crashed(assigned: Assigned, error: Exception) -> Outcome:
    path = assigned.folder / ERROR
    write_note(path, "".join(traceback.format_exception(error)))
    return Outcome(assigned.name, CRASHED, f"{first_line(error)}; see {path}")


def read_progress(folder: Path) -> tuple[int, str]:
    """The steps that a run has done, and the mean return of its last evaluation as text."""
    with suppress(InputError, ValueError):
        step, mean = read_file(folder / PROGRESS).decode().split()
        return int(step), mean
    return 0, "-"


class _ProgressFiles:
    """Tells the parent process, through files, how far runs are."""

    def __init__(self, steps: int) -> None:
        self._steps = steps  # of each run
        self._written: dict[Path, float] = {}

    def __call__(self, job: Job, step: int) -> None:
        now, folder, mean = time.monotonic(), job.folder, job.history.mean
        if step >= self._steps or now - self._written.get(folder, 0.0) >= _WRITE_EVERY:
            shown = "-" if mean is None else rounded(mean)[0]
            write_note(folder / PROGRESS, f"{step} {shown}")
            self._written[folder] = now


def say(line: str) -> None:
    """Print a line on standard error, above a live table; a study goes on where that fails."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)
