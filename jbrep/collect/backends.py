"""Where shards are made: in this process, in others on this machine, or on a Ray cluster."""

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from typing import Any

from jbrep.collect.shards import Missing, Produce, Simulator
from jbrep.dataset.schema import Columns
from jbrep.envs.make import is_batched
from jbrep.envs.names import import_modules, imported_modules
from jbrep.envs.recording import Tick
from jbrep.errors import InputError, first_line
from jbrep.pool import ATTEMPTS, Pool, on_cluster, stop_requested


def local(simulator: Simulator) -> Produce:
    """A batch's shards in turn on threads; other environments' side by side in processes."""
    workers = simulator.num_threads or os.cpu_count() or 1
    if is_batched(simulator.settings.task) or workers == 1:
        return simulator.in_turn
    return _in_processes(replace(simulator, lanes=1, num_threads=1), workers)


def _in_processes(simulator: Simulator, workers: int) -> Produce:
    """Shards made side by side, given in order; one whose worker is killed is made again."""

    def produce(first: int, missing: Missing, tick: Tick) -> Iterator[Columns]:
        if not missing.wants(first + 1):  # one shard alone
            yield from simulator.in_turn(first, missing, tick)
            return
        made: dict[int, Columns | str] = {}
        started, attempts = first, dict[int, int]()
        with Pool[int, Columns | str](make_shard, workers, lambda: None) as pool:

            def submit(shard: int) -> None:
                pool.submit(shard, imported_modules(), simulator, shard, missing.rows)

            for shard in count(first):
                while shard not in made:
                    most = shard + 2 * workers  # held in memory until those before are made
                    while not pool.is_full and (
                        started == shard or (started < most and missing.wants(started))
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
                yield _columns(made.pop(shard))

    return produce


def make_shard(
    modules: tuple[str, ...], simulator: Simulator, shard: int, rows: int
) -> Columns | str:
    """A shard, in a process of its own; the message of an error that a user can mend."""
    try:
        import_modules(modules)
        return simulator.shard(shard, _stop_on_request, rows)
    except InputError as error:
        return str(error)


def _columns(result: Columns | str) -> Columns:
    """What `make_shard` returned; its error only once the shard is needed."""
    if isinstance(result, str):
        raise InputError(result)
    return result


def _stop_on_request(steps: int) -> None:
    if stop_requested():
        raise SystemExit


def on_ray(simulator: Simulator) -> Produce:
    """Shards made side by side on the Ray cluster that RAY_ADDRESS names, or else on a local one.

    Only this process writes to the data set's folder. The shards of a node that dies are made
    again on another.
    """

    def produce(first: int, missing: Missing, tick: Tick) -> Iterator[Columns]:
        import ray

        make = on_cluster(make_shard, simulator.num_threads)
        alone = replace(simulator, lanes=1, num_threads=1)
        started, made = first, dict[int, Any]()
        try:
            for shard in count(first):
                ahead = shard + 2 * int(ray.cluster_resources().get("CPU", 1))
                while started == shard or (started < ahead and missing.wants(started)):
                    made[started] = make.remote(imported_modules(), alone, started, missing.rows)
                    started += 1
                yield _columns(ray.get(made.pop(shard)))
        except ray.exceptions.RayError as error:
            reason = first_line(error)
            raise InputError(f"the cluster could not make shard {shard}: {reason}") from error
        finally:
            for job in made.values():
                ray.cancel(job, force=True)

    return produce


BACKENDS: dict[str, Callable[[Simulator], Produce]] = {"local": local, "ray": on_ray}
