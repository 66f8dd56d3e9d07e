"""Workers that take one job at a time: processes on this machine, or a Ray cluster's.

Processes never outlive the one that started them. This module imports the standard library alone,
so that a new one watches its parent before the seconds that it takes to import torch.
"""

import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any, Generic, TypeVar

ATTEMPTS = 5  # at a job whose worker is killed
_ANSWERS_WITHIN = 10.0  # seconds, a cluster
_STOPPING_SECONDS = 60.0  # that jobs under way have to stop before they are killed
_SINGLE_THREADED = dict.fromkeys(
    ("MKL_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
_stop = threading.Event()  # set in a worker that is asked to stop
_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


class WorkerError(RuntimeError):
    """A job raised an error, whose traceback the worker has shown; its last line."""


class Pool(Generic[_Job, _Result]):
    """Workers, started as they are needed; those that die are replaced.

    On leaving its context, jobs under way are asked to stop (see `stop_requested`) and waited for.

    Args:
        function: what a worker calls with a job's arguments; importable by its name.
        size: the most workers at a time.
        stopping: called on leaving with jobs under way.
    """

    def __init__(self, function: Callable[..., _Result], size: int, stopping: Callable[[], None]):
        self._function, self._size, self._stopping = function, size, stopping
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, tuple[_Worker, _Job]] = {}

    def __enter__(self) -> "Pool[_Job, _Result]":
        return self

    def __exit__(self, *error: object) -> None:
        busy = [worker for worker, _ in self._busy.values()]
        workers = [*busy, *self._idle]
        try:
            for worker in busy:
                worker.process.terminate()
            for worker in workers:
                worker.connection.close()
            if busy:
                self._stopping()
            deadline = time.monotonic() + _STOPPING_SECONDS
            for worker in workers:
                worker.process.join(max(deadline - time.monotonic(), 0))
        finally:  # at once if this is interrupted, too
            for worker in workers:
                worker.process.kill()
                worker.process.join()

    @property
    def is_full(self) -> bool:
        """Whether every worker has a job."""
        return len(self._busy) >= self._size

    @property
    def is_idle(self) -> bool:
        """Whether no worker has a job."""
        return not self._busy

    def submit(self, job: _Job, *arguments: Any) -> None:
        """Give a job to a worker."""
        worker = self._idle.pop() if self._idle else _Worker()
        self._busy[worker.connection] = worker, job
        with suppress(OSError):  # it died: `result` notices
            worker.connection.send((self._function, arguments))

    def result(self) -> tuple[_Job, _Result | None]:
        """Wait for a job to end: what it returned, or None if its worker died or was stopped.

        Raises:
            WorkerError: it raised an error.
        """
        connection = wait(list(self._busy))[0]
        assert isinstance(connection, Connection)
        worker, job = self._busy.pop(connection)
        try:
            result: _Result | WorkerError = connection.recv()
        except (EOFError, OSError):
            connection.close()
            worker.process.join()
            return job, None
        self._idle.append(worker)
        if isinstance(result, WorkerError):
            raise result
        return job, result


class _Worker:
    """A process, and the parent's end of the connection to it."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _without_script():
            self.process.start()
        theirs.close()


@contextmanager
def _without_script() -> Iterator[None]:
    """Keep a new process from running the script that this one runs: it may have no main guard."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def stop_requested() -> bool:
    """Whether this process is a worker that has been asked to stop."""
    return _stop.is_set()


def _serve(connection: Connection) -> None:
    """Work on one job after the other, until the parent closes the connection."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then asks
    signal.signal(signal.SIGTERM, lambda number, frame: _stop.set())
    os.environ.update(_SINGLE_THREADED)
    with suppress(EOFError, OSError):
        while True:
            result = _result(connection)
            if stop_requested():
                return
            connection.send(result)


def _result(connection: Connection) -> Any:
    """What the next job returns, or the error that it raises; a job may not even be readable."""
    try:
        function, arguments = connection.recv()
    except (EOFError, OSError):  # the parent is gone
        raise
    except Exception as error:
        return _told(error)
    try:
        return function(*arguments)
    except Exception as error:
        return _told(error)


def _told(error: Exception) -> WorkerError:
    traceback.print_exception(error)
    return WorkerError(f"a worker failed: {type(error).__name__}: {error}")


def _end_with_parent() -> None:
    """End this process at once when its parent has ended; a run can be cut off anywhere."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def on_cluster(function: Callable[..., Any], cpus: int | None, gpus: int = 0) -> Any:
    """A function as Ray's remote function, on a core each, called again if its node dies.

    Args:
        function: to run.
        cpus: of the local cluster that is started where RAY_ADDRESS names none; None takes all.
        gpus: that it needs.
    """
    import ray

    if not ray.is_initialized():
        _connect(os.environ.get("RAY_ADDRESS"), cpus)
    return ray.remote(num_cpus=1, num_gpus=gpus, max_retries=ATTEMPTS - 1)(function)


def _connect(address: str | None, cpus: int | None) -> None:
    """Join the cluster at an address, or start one where none is given."""
    import ray

    from jbrep.errors import InputError, first_line

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        host, _, port = (address or "").removeprefix("ray://").rpartition(":")
        if host and port.isdecimal():  # Ray itself tries for minutes, and tells each time
            socket.create_connection((host, int(port)), _ANSWERS_WITHIN).close()
        ray.init(num_cpus=None if address else cpus, include_dashboard=False, **quiet)
    except Exception as error:  # of its many kinds Ray's plainest, too
        where = f"at RAY_ADDRESS={address}" if address else "on this machine"
        raise InputError(f"no Ray cluster {where}: {first_line(error)}") from error
