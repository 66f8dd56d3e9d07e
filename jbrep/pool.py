"""Jobs side by side: in loky's processes on this machine, or as tasks of a Ray cluster.

This module imports next to nothing but the standard library, so that a new process watches its
parent before the seconds that it takes to import torch.
"""

import os
import signal
import socket
import threading
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import suppress
from multiprocessing import Pipe, get_all_start_methods, set_start_method
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from jbrep.errors import Notice
from jbrep.text import noted

ATTEMPTS = 5  # at a job whose process is killed
KILLED = f"was killed {ATTEMPTS} times, perhaps because memory ran out: try fewer"
_ANSWERS_WITHIN = 10.0  # seconds, a cluster
_CLOSED_WITHIN = 60.0  # seconds, what a process has open
_SINGLE_THREADED = dict.fromkeys(
    ("MKL_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
_stop = threading.Event()  # set in a process that is asked to stop
_Job = TypeVar("_Job")
_Result = TypeVar("_Result")


def side_by_side(
    function: Callable[[_Job], _Result],
    next_job: Callable[[], _Job | None],
    workers: int,
    patience: float = 0.0,
    stopping: Callable[[], None] = lambda: None,
) -> Generator[tuple[_Job, _Result | None]]:
    """Run jobs in processes of one thread each; yield each with its result, as they end.

    A job whose process is killed is tried again; after five times it is given up, with None as its
    result. On leaving, jobs under way are asked to stop (see `stop_requested`), and killed once
    that has taken too long. Processes never outlive this one.

    Args:
        function: what a process calls with a job.
        next_job: what to begin; None if there is nothing, at least until another job has ended.
        workers: the most processes at a time.
        patience: how long jobs may take to stop [s].
        stopping: called on leaving with jobs under way.
    """
    again, idle = deque[tuple[_Job, int]](), list[_Worker]()
    under_way: dict[Future[_Result], tuple[_Worker, _Job, int]] = {}
    try:
        while True:
            while len(under_way) < workers and (each := _next(again, next_job)):
                worker = idle.pop() if idle else _Worker()
                under_way[worker.submit(function, each[0])] = worker, *each
            if not under_way:
                return
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                worker, job, attempt = under_way.pop(future)
                if not worker.was_killed(future):
                    idle.append(worker)
                    yield job, future.result()
                    continue
                worker.end(kill=True)
                if attempt < ATTEMPTS:
                    again.append((job, attempt + 1))
                else:
                    yield job, None
    finally:
        busy = {future: worker for future, (worker, _, _) in under_way.items()}
        try:
            for worker in busy.values():
                worker.ask_to_stop()
            if busy:
                stopping()
                wait(busy, timeout=patience)
        finally:  # at once if this is interrupted, too
            _end(idle, busy)


def _next(
    again: deque[tuple[_Job, int]], next_job: Callable[[], _Job | None]
) -> tuple[_Job, int] | None:
    """A job to begin, and the number of the attempt."""
    if again:
        return again.popleft()
    job = next_job()
    return None if job is None else (job, 1)


class _Worker:
    """An executor of one process, so that it is known whose job a process takes along."""

    def __init__(self) -> None:
        from joblib.externals import loky  # which takes a moment

        self._read_by_process, self._connection = Pipe(duplex=False)
        self._executor = loky.ProcessPoolExecutor(
            1, initializer=_begin, initargs=(self._read_by_process,), env=_SINGLE_THREADED
        )

    def submit(self, function: Callable[[_Job], _Result], job: _Job) -> Future[_Result]:
        """Give a job to the process."""
        future = Future[_Result]()
        try:
            future = self._executor.submit(function, job)
        except BrokenExecutor as error:  # it was killed meanwhile
            future.set_exception(error)
        return future

    def was_killed(self, future: Future[Any]) -> bool:
        """Whether a job ended as its process did."""
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        return isinstance(future.exception(), TerminatedWorkerError)

    def ask_to_stop(self) -> None:
        """Let `stop_requested` be true in the process."""
        with suppress(OSError):  # it was killed meanwhile
            self._connection.send(None)

    def end(self, kill: bool) -> None:
        """End the process, at once or when it has closed what it has open."""
        self._executor.shutdown(kill_workers=kill)
        self.leave()

    def leave(self) -> None:
        """Let the process end at once, as if this one had ended."""
        self._connection.close()


def _end(idle: Iterable[_Worker], busy: Mapping[Future[Any], _Worker]) -> None:
    """End processes side by side, those that still have a job at once."""
    kill = dict.fromkeys(idle, False) | {busy[each]: not each.done() for each in busy}
    ends = [threading.Thread(target=each.end, args=(kill[each],), daemon=True) for each in kill]
    for end in ends:
        end.start()
    for end in ends:
        end.join(_CLOSED_WITHIN)
    for worker in kill:
        worker.leave()


def _begin(connection: Connection) -> None:
    """Begin a process, in which an environment may start others as usual, not by loky."""
    set_start_method(get_all_start_methods()[0], force=True)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then asks
    signal.signal(signal.SIGTERM, lambda number, frame: None)  # likewise
    threading.Thread(target=_listen, args=(connection,), daemon=True).start()
    usual = warnings.formatwarning

    def formatted(message: Any, category: type[Warning], *where: Any, **more: Any) -> str:
        if not issubclass(category, Notice):
            return usual(message, category, *where, **more)
        return f"{noted(str(message))}\n"

    warnings.formatwarning = formatted


def _listen(connection: Connection) -> None:
    """Note when the parent asks to stop; end this process at once when the parent has ended."""
    with suppress(EOFError, OSError):
        connection.recv()
        _stop.set()
        connection.recv()
    os._exit(1)


def stop_requested() -> bool:
    """Whether this process is one that has been asked to stop."""
    return _stop.is_set()


def on_cluster(function: Callable[..., Any], cpus: int, gpus: int) -> Any:
    """A function as Ray's remote function, on a core each, called again if its node dies.

    Args:
        function: to run.
        cpus: of the local cluster that is started where RAY_ADDRESS names none.
        gpus: that it needs.
    """
    import ray

    if not ray.is_initialized():
        _connect(os.environ.get("RAY_ADDRESS"), cpus)
    return ray.remote(num_cpus=1, num_gpus=gpus, max_retries=ATTEMPTS - 1)(function)


def _connect(address: str | None, cpus: int) -> None:
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
