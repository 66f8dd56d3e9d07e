"""Runs of a study, in a process of their own."""

import sys
import time
import traceback
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from jbrep.envs.names import import_modules
from jbrep.errors import InputError, first_line
from jbrep.pool import stop_requested
from jbrep.records.storage import make_folder, read_file, write_note
from jbrep.rl import Run, Session, StoppedError, train
from jbrep.rl.history import History
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


def work(assigned: Assigned, modules: Iterable[str] = ()) -> Outcome | None:
    """Train a run; an error is reported in its outcome and stops no other run.

    Args:
        assigned: the run.
        modules: to import first, as they register environments.

    Returns:
        How the run ended; None if it was stopped.
    """
    try:
        make_folder(assigned.folder)
        import_modules(modules)
        watch = _ProgressFile(assigned.folder, assigned.run.steps)
        result = train(assigned.run, assigned.folder, Session(watch, stop=stop_requested))
    except StoppedError:
        return None
    except Exception as error:
        return _crashed(assigned, error)
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


class _ProgressFile:
    """Tells the parent process, through a file, how far a run is."""

    def __init__(self, folder: Path, steps: int) -> None:
        self._path, self._steps, self._written = folder / PROGRESS, steps, 0.0

    def __call__(self, history: History, step: int) -> None:
        now = time.monotonic()
        if step >= self._steps or now - self._written >= _WRITE_EVERY:
            shown = rounded(history.means[-1])[0] if history.evaluations else "-"
            write_note(self._path, f"{step} {shown}")
            self._written = now


def say(line: str) -> None:
    """Print a line on standard error, above a live table; a study goes on where that fails."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)
