"""Where shards are made: in this process, in others on this machine, or on a Ray cluster."""

import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from jbrep.collect.shards import Made, Produce, Remaining, Simulator, all_of
from jbrep.dataset.schema import Columns
from jbrep.envs.instances import close_kept
from jbrep.envs.make import is_batched
from jbrep.envs.names import import_modules, imported_modules, spec_of
from jbrep.envs.recording import Tick
from jbrep.errors import InputError, first_line
from jbrep.machine import cores
from jbrep.pool import ATTEMPTS, Pool, on_cluster, stop_requested


def local(simulator: Simulator) -> Produce:
    """A batch's shards in turn on threads; other environments' side by side in processes."""
    workers = simulator.num_threads or cores()
    task = simulator.settings.task
    if is_batched(task) or workers == 1 or not _can_be_sent(spec_of(task), simulator):
        return simulator.in_turn
    return _in_processes(replace(simulator, lanes=1, num_threads=1), workers)


def _can_be_sent(*parts: Any) -> bool:
    """Whether other processes can make what this one has, though they don't run its script.

    They can't make classes of a script or notebook, which stand in `__main__`.
    """
    try:
        return b"__main__" not in pickle.dumps(parts)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False


def _in_processes(simulator: Simulator, workers: int) -> Produce:
    """Shards made side by side, given in order; one whose worker is killed is made again."""

    def produce(first: int, remaining: Remaining, tick: Tick) -> Iterator[Columns]:
        if not remaining.wants(first + 1):  # one shard alone
            yield from simulator.in_turn(first, remaining, tick)
            return
        made: dict[int, Made] = {}
        started, attempts = first, dict[int, int]()
        known = imported_modules(), spec_of(simulator.settings.task)
        close_kept()  # the workers have their own
        with Pool[int, Made](make_shard, workers, lambda: None) as pool:

            def submit(shard: int) -> None:
                begun = remaining.begun(shard)
                pool.submit(shard, known, simulator, shard, remaining.rows, begun)

            for shard in count(first):
                while shard not in made:
                    most = shard + 2 * workers  # held in memory until those before are made
                    while not pool.is_full and (
                        started == shard or (started < most and remaining.wants(started))
                    ):
                        submit(started)
                        started += 1
                    number, columns = pool.result()
                    if columns is not None:
                        made[number] = columns
                        continue
                    attempts[number] = attempts.get(number, 0) + 1
                    if attempts[number] == ATTEMPTS:
                        raise InputError(
                            f"the worker of shard {number} was killed {ATTEMPTS} times, perhaps "
                            "because memory ran out: try fewer --threads"
                        )
                    submit(number)
                yield from all_of(made.pop(shard))

    return produce


def make_shard(
    known: tuple[tuple[str, ...], EnvSpec], simulator: Simulator, shard: int, rows: int, begun: int
) -> Made:
    """What is missing of a shard, in a process of its own.

    Args:
        known: modules to import, and what the environment is, if none of them registers it.
        simulator: makes it.
        shard: its number.
        rows: how many are enough.
        begun: episodes of it that are there.
    """
    modules, spec = known
    try:
        import_modules(modules)
        gymnasium.registry.setdefault(spec.id, spec)
        return simulator.made(shard, _stop_on_request, rows, begun)
    except InputError as error:
        return Made(None, str(error))


def _stop_on_request(steps: int) -> None:
    if stop_requested():
        raise SystemExit


def on_ray(simulator: Simulator) -> Produce:
    """Shards made side by side on the Ray cluster that RAY_ADDRESS names, or else on a local one.

    Only this process writes to the data set's folder. The shards of a node that dies are made
    again on another.
    """

    def produce(first: int, remaining: Remaining, tick: Tick) -> Iterator[Columns]:
        import ray

        make = on_cluster(make_shard, simulator.num_threads)
        alone = replace(simulator, lanes=1, num_threads=1)
        known = imported_modules(), spec_of(simulator.settings.task)
        started, made = first, dict[int, Any]()
        try:
            for shard in count(first):
                ahead = shard + 2 * int(ray.cluster_resources().get("CPU", 1))
                while started == shard or (started < ahead and remaining.wants(started)):
                    begun = remaining.begun(started)
                    what = known, alone, started, remaining.rows, begun
                    made[started] = make.remote(*what)
                    started += 1
                yield from all_of(ray.get(made.pop(shard)))
        except ray.exceptions.RayError as error:
            reason = first_line(error)
            raise InputError(f"the cluster could not make shard {shard}: {reason}") from error
        finally:
            for job in made.values():
                ray.cancel(job, force=True)

    return produce


BACKENDS: dict[str, Callable[[Simulator], Produce]] = {"local": local, "ray": on_ray}
