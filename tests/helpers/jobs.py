"""Jobs of worker processes. Nothing heavy is imported: each new process imports this."""

import os
import signal
import time
import warnings

from jbrep.errors import Notice
from jbrep.pool import side_by_side, stop_requested


def begun(function, jobs, workers, *given):
    jobs = iter(jobs)
    return side_by_side(function, lambda: next(jobs, None), workers, *given)


def square(number):
    return number**2, os.getpid()


def die(folder):
    """Take the worker along at the first two times."""
    with (folder / "deaths").open("a") as file:
        file.write("x")
    if len((folder / "deaths").read_text()) <= 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return "survived"


def note(what):
    warnings.warn("it is wet", Notice, stacklevel=1)


def fail(what):
    raise KeyError(what)


def kill_worker_of_first_run(name, known):
    """Used instead of `work`."""
    if name.name == "first":
        os.kill(os.getpid(), signal.SIGKILL)
    return f"outcome of {name.name}"


def hang(folder):
    (folder / "at-work").touch()
    while not stop_requested():
        time.sleep(0.01)
    (folder / "stopped").touch()


def never_stop(folder):
    (folder / "at-work").touch()
    time.sleep(600)
