"""The runs of a study, side by side: on this machine, or on a Ray cluster."""

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from typing import Any

from jbrep.cluster import on_cluster
from jbrep.envs.names import imported_modules
from jbrep.errors import choose
from jbrep.pool import ATTEMPTS, Pool, stop_requested
from jbrep.study.plan import Cell, Plan
from jbrep.study.progress import say
from jbrep.study.work import CRASHED, Outcome, work

Backend = Callable[[Plan, Iterable[Cell], int], Generator[Outcome]]


def on_this_machine(plan: Plan, cells: Iterable[Cell], workers: int) -> Generator[Outcome]:
    """Bring runs to their end in processes of one thread each; yield each outcome as it comes.

    A run whose worker is killed is resumed from its checkpoint by another. One that has lost five
    workers has crashed. Closed early, this waits until the runs under way have written their
    checkpoints.
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

    task = on_cluster(work, workers)
    names = {task.remote(*_job(plan, cell)): cell.name for cell in cells}
    try:
        while names:
            (done,), _ = ray.wait(list(names))
            name = names.pop(done)
            try:
                outcome = ray.get(done)
            except ray.exceptions.RayError:
                outcome = _killed(name)
            yield outcome
    finally:
        for job in names:
            ray.cancel(job, force=True)


BACKENDS: dict[str, Backend] = {
    "local": on_this_machine,
    "ray": on_ray,
    "joblib": on_this_machine,  # what 0.1.0 called it
}


def get_backend(name: str) -> Backend:
    """A way to run.

    Raises:
        InputError: there is none of that name; the message lists them.
    """
    return choose(name, BACKENDS, "backend")


def _job(plan: Plan, cell: Cell) -> tuple[Any, ...]:
    """The arguments of `work`."""
    run, folder = plan.run(cell), plan.folder_of(cell)
    return cell.name, run, folder, stop_requested, imported_modules()
