"""The runs of a study, side by side: on this machine, or on a Ray cluster."""

import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError

from jbrep.errors import InputError, choose
from jbrep.study.plan import Cell, Plan
from jbrep.study.work import Outcome, work

_TRIES = 5  # of a run whose worker is killed

Backend = Callable[[Plan, Iterable[Cell], int], Iterator[Outcome]]


def on_this_machine(plan: Plan, cells: Iterable[Cell], workers: int) -> Iterator[Outcome]:
    """Bring runs to their end in processes of one thread each; each one's outcome as it comes.

    Runs whose worker is killed are gone on with, from their checkpoints.

    Raises:
        InputError: workers are killed again and again.
    """
    left = {cell.name: cell for cell in cells}
    for _ in range(_TRIES):
        try:
            with parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
                jobs = (delayed(work)(*_job(plan, cell)) for cell in list(left.values()))
                for outcome in Parallel(return_as="generator_unordered", batch_size=1)(jobs):
                    del left[outcome.name]
                    yield outcome
            return
        except TerminatedWorkerError:
            continue
        finally:
            if workers > 1:
                get_reusable_executor().shutdown(wait=True, kill_workers=True)
    raise InputError(
        f"workers were killed {_TRIES} times, perhaps for want of memory: take fewer --workers"
    )


def on_ray(plan: Plan, cells: Iterable[Cell], workers: int) -> Iterator[Outcome]:
    """The same on the Ray cluster that RAY_ADDRESS names, or on one of this machine's.

    All nodes need the study's folder at the same path. What a node was at when it died is gone on
    with on another.
    """
    import ray

    if not ray.is_initialized():
        ray.init(num_cpus=None if "RAY_ADDRESS" in os.environ else workers, **_QUIET)
    task = ray.remote(num_cpus=1, max_retries=_TRIES)(work)
    left = [task.remote(*_job(plan, cell)) for cell in cells]
    try:
        while left:
            (done,), left = ray.wait(left)
            yield ray.get(done)
    finally:
        for job in left:
            ray.cancel(job, force=True)


_QUIET: dict[str, Any] = {
    "log_to_driver": False,
    "logging_level": "ERROR",
    "include_dashboard": False,
}
BACKENDS: dict[str, Backend] = {"joblib": on_this_machine, "ray": on_ray}


def get_backend(name: str) -> Backend:
    """A way to run.

    Raises:
        InputError: there is none of that name; the message lists them.
    """
    return choose(name, BACKENDS, "backend")


def _job(plan: Plan, cell: Cell) -> tuple[Any, ...]:
    """What `work` takes."""
    return cell.name, plan.run(cell), plan.folder_of(cell), os.getpid()
