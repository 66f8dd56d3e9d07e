"""One run of a study, in a process of its own."""

import os
import signal
import threading
import time
import traceback
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from jbrep.files.storage import make_folder
from jbrep.rl import Run, train

PROGRESS = "progress"
ERROR = "error.txt"  # why a run could not be brought to its end
CRASHED = "crashed"
_EVERY = 1.0  # seconds


class Outcome(NamedTuple):
    """What came of a run."""

    name: str
    status: str  # finished, failed or crashed
    words: str  # why, or how well


def work(name: str, run: Run, folder: Path, parent: int) -> Outcome:
    """Train; whatever goes wrong is told and stops no other run.

    Args:
        name: of the run.
        run: what to train.
        folder: its own.
        parent: the process that is waiting; this one ends with it.
    """
    if os.getppid() == parent:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
        _watch(parent)
    try:
        make_folder(folder)
        result = train(run, folder, _Reporter(folder))
    except Exception as error:
        with suppress(OSError):
            (folder / ERROR).write_text(traceback.format_exc())
        return Outcome(name, CRASHED, f"{error}; see {folder / ERROR}")
    for left in (PROGRESS, ERROR):
        (folder / left).unlink(missing_ok=True)
    words = result.get("reason", f"{result['seconds'] / 60:.1f} min")
    return Outcome(name, result["status"], words)


def read_progress(folder: Path) -> tuple[int, str]:
    """How many steps a run has done, and the mean return of its last evaluation in words."""
    with suppress(OSError, ValueError):
        step, mean = (folder / PROGRESS).read_text().split()
        return int(step), mean
    return 0, "-"


class _Reporter:
    """Tells the parent, through a file, how far a run is."""

    def __init__(self, folder: Path):
        self._path, self._told = folder / PROGRESS, 0.0

    def __call__(self, step: int, mean: float | None) -> None:
        now = time.monotonic()
        if now - self._told >= _EVERY:
            self._path.write_text(f"{step} {'-' if mean is None else f'{mean:.0f}'}")
            self._told = now


@cache  # once for each process
def _watch(parent: int) -> None:
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """Go when the parent is gone: a run can be cut off anywhere."""
    while os.getppid() == parent:
        time.sleep(_EVERY)
    os._exit(1)
