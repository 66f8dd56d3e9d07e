"""One run of a study, in a process of its own."""

import time
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from jbrep.envs.names import import_modules
from jbrep.files.storage import make_folder
from jbrep.rl import Run, StoppedError, train
from jbrep.text import rounded

PROGRESS = "progress"
ERROR = "error.txt"  # the traceback of a run that crashed
CRASHED = "crashed"
_WRITE_EVERY = 1.0  # seconds


class Outcome(NamedTuple):
    """How a run ended."""

    name: str
    status: str  # finished, failed or crashed
    message: str  # the reason, or how long it took


def work(
    name: str,
    run: Run,
    folder: Path,
    stop: Callable[[], bool] = lambda: False,
    modules: Iterable[str] = (),
) -> Outcome | None:
    """Train; an error is reported in the outcome and stops no other run.

    Args:
        name: of the run.
        run: what to train.
        folder: of this run alone.
        stop: whether to write a checkpoint and stop now.
        modules: to import first, as they register environments.

    Returns:
        How the run ended; None if it was stopped.
    """
    try:
        make_folder(folder)
        import_modules(modules)
        result = train(run, folder, _ProgressFile(folder), stop=stop)
    except StoppedError:
        return None
    except Exception as error:
        with suppress(OSError):
            (folder / ERROR).write_text(traceback.format_exc())
        reason = str(error).partition("\n")[0] or type(error).__name__
        return Outcome(name, CRASHED, f"{reason}; see {folder / ERROR}")
    for leftover in (PROGRESS, ERROR):
        (folder / leftover).unlink(missing_ok=True)
    message = result.get("reason", f"{result['seconds'] / 60:.1f} min")
    return Outcome(name, result["status"], message)


def read_progress(folder: Path) -> tuple[int, str]:
    """The steps that a run has done, and the mean return of its last evaluation as text."""
    with suppress(OSError, ValueError):
        step, mean = (folder / PROGRESS).read_text().split()
        return int(step), mean
    return 0, "-"


class _ProgressFile:
    """Tells the parent process, through a file, how far a run is."""

    def __init__(self, folder: Path):
        self._path, self._written = folder / PROGRESS, 0.0

    def __call__(self, step: int, mean: float | None) -> None:
        now = time.monotonic()
        if now - self._written >= _WRITE_EVERY:
            self._path.write_text(f"{step} {'-' if mean is None else rounded(mean)[0]}")
            self._written = now
