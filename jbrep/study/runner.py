"""The runs of a study, side by side: on this machine, or on a Ray cluster."""

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from typing import Any

from jbrep.envs.names import imported_modules
from jbrep.errors import choose
from jbrep.pool import ATTEMPTS, Pool, on_cluster, stop_requested
from jbrep.rl.settings import CUDA
from jbrep.study.packing import Pack
from jbrep.study.plan import Plan
from jbrep.study.progress import say
from jbrep.study.work import CRASHED, Outcome, work

Backend = Callable[[Plan, Iterable[Pack], int], Generator[Outcome]]


def on_this_machine(plan: Plan, packs: Iterable[Pack], workers: int) -> Generator[Outcome]:
    """Bring runs to their end in processes of one thread each; yield the outcomes as they come.

    Runs whose worker is killed are resumed from their checkpoints by others, in packs of half the
    size, as memory may have run out. One that has lost five workers has crashed. Closed early, this
    waits until the runs under way have written their checkpoints.
    """
    waiting, deaths = deque(packs), Counter[str]()
    with Pool[Pack, list[Outcome] | None](work, workers, _announce_stop) as pool:
        while waiting or not pool.is_idle:
            while waiting and not pool.is_full:
                pack = waiting.popleft()
                pool.submit(pack, *_job(plan, pack))
            pack, outcomes = pool.result()
            if outcomes is not None:
                yield from outcomes
                continue
            deaths.update(cell.name for cell in pack)
            yield from (_killed(cell.name) for cell in pack if deaths[cell.name] == ATTEMPTS)
            left = [cell for cell in pack if deaths[cell.name] < ATTEMPTS]
            waiting += [half for half in (tuple(left[::2]), tuple(left[1::2])) if half]


def _announce_stop() -> None:
    say("stopping: the runs under way write their checkpoints; Ctrl-C again ends them at once")


def _killed(name: str) -> Outcome:
    reason = f"its worker was killed {ATTEMPTS} times, perhaps because memory ran out"
    return Outcome(name, CRASHED, f"{reason}: try fewer --workers")


def on_ray(plan: Plan, packs: Iterable[Pack], workers: int) -> Generator[Outcome]:
    """The same on the Ray cluster that RAY_ADDRESS names, or else on a local one.

    All nodes need the study's folder at the same path. The runs of a node that dies are resumed on
    another. Closed early, this cancels the runs under way; their checkpoints are up to a minute
    old.
    """
    import ray

    task = on_cluster(work, workers, gpus=int(plan.device == CUDA))
    under_way = {task.remote(*_job(plan, pack)): pack for pack in packs}
    try:
        while under_way:
            (done,), _ = ray.wait(list(under_way))
            pack = under_way.pop(done)
            try:
                outcomes = ray.get(done)
            except ray.exceptions.RayError as error:
                reason = str(error).strip().rpartition("\n")[2]
                outcomes = [Outcome(cell.name, CRASHED, reason) for cell in pack]
            yield from outcomes
    finally:
        for job in under_way:
            ray.cancel(job, force=True)


BACKENDS: dict[str, Backend] = {"local": on_this_machine, "ray": on_ray}


def get_backend(name: str) -> Backend:
    """A way to run.

    Raises:
        InputError: there is none of that name; the message lists them.
    """
    return choose(name, BACKENDS, "backend")


def _job(plan: Plan, pack: Pack) -> tuple[Any, ...]:
    """The arguments of `work`."""
    return plan.assigned(pack), stop_requested, imported_modules()
