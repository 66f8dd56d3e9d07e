"""Where episodes are made: in this process, in others on this machine, or on a Ray cluster."""

import math
import pickle
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
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

_PIECES = 10  # of a shard: what a worker makes at a time
_AHEAD = 4  # pieces for each worker, begun or held until those before are made


def local(simulator: Simulator) -> Produce:
    """A batch's episodes in turn on threads; other environments' side by side in processes."""
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


def _pieces(simulator: Simulator, first: int, remaining: Remaining) -> Iterator[range]:
    """The episodes that are missing from a shard on, some of one shard at a time."""
    each = simulator.settings.shard_episodes
    size = math.ceil(each / _PIECES)
    begin = first * each + remaining.begun(first)
    while True:
        end = min(begin + size, (begin // each + 1) * each)
        yield range(begin, end)
        begin = end


def _in_processes(simulator: Simulator, workers: int) -> Produce:
    """Pieces made side by side, given in order; one whose worker is killed is made again."""
    most = _AHEAD * workers

    def produce(first: int, remaining: Remaining, tick: Tick) -> Iterator[Columns]:
        if not remaining.wants((first + 1) * simulator.settings.shard_episodes):  # one shard alone
            yield from simulator.in_turn(first, remaining, tick)
            return
        pieces = _pieces(simulator, first, remaining)
        coming, waiting = next(pieces), deque[range]()
        made, attempts = dict[range, Made](), Counter[range]()
        known = imported_modules(), spec_of(simulator.settings.task)
        close_kept()  # the workers have their own
        with Pool[range, Made](make_episodes, workers, lambda: None) as pool:
            while True:
                while not pool.is_full and _is_next(coming, waiting, most, remaining):
                    pool.submit(coming, known, simulator, coming)
                    waiting.append(coming)
                    coming = next(pieces)
                if waiting[0] in made:
                    yield from all_of(made.pop(waiting.popleft()))
                    continue
                piece, result = pool.result()
                if result is not None:
                    made[piece] = result
                    continue
                attempts[piece] += 1
                if attempts[piece] == ATTEMPTS:
                    raise InputError(
                        f"the worker that began with episode {piece.start} was killed "
                        f"{ATTEMPTS} times, perhaps because memory ran out: try fewer --threads"
                    )
                pool.submit(piece, known, simulator, piece)

    return produce


def _is_next(coming: range, waiting: Sequence[Any], most: int, remaining: Remaining) -> bool:
    """Whether a piece is to be begun beside those that aren't given yet."""
    return not waiting or (len(waiting) < most and remaining.wants(coming.start))


def make_episodes(
    known: tuple[tuple[str, ...], EnvSpec], simulator: Simulator, episodes: range
) -> Made:
    """Some episodes, in a process of its own.

    Args:
        known: modules to import, and what the environment is, if none of them registers it.
        simulator: makes them.
        episodes: of one shard.
    """
    modules, spec = known
    try:
        import_modules(modules)
        gymnasium.registry.setdefault(spec.id, spec)
        return simulator.made(episodes, _stop_on_request)
    except InputError as error:
        return Made(None, str(error))


def _stop_on_request(steps: int) -> None:
    if stop_requested():
        raise SystemExit


def on_ray(simulator: Simulator) -> Produce:
    """Pieces made side by side on the Ray cluster that RAY_ADDRESS names, or else on a local one.

    Only this process writes to the data set's folder. The pieces of a node that dies are made
    again on another.
    """

    def produce(first: int, remaining: Remaining, tick: Tick) -> Iterator[Columns]:
        import ray

        make = on_cluster(make_episodes, simulator.num_threads)
        alone = replace(simulator, lanes=1, num_threads=1)
        known = imported_modules(), spec_of(simulator.settings.task)
        pieces = _pieces(simulator, first, remaining)
        coming, waiting = next(pieces), deque[Any]()
        try:
            while True:
                most = _AHEAD * int(ray.cluster_resources().get("CPU", 1))
                while _is_next(coming, waiting, most, remaining):
                    waiting.append(make.remote(known, alone, coming))
                    coming = next(pieces)
                made = ray.get(waiting[0])
                waiting.popleft()
                yield from all_of(made)
        except ray.exceptions.RayError as error:
            reason = first_line(error)
            raise InputError(f"the cluster could not make episodes: {reason}") from error
        finally:
            for job in waiting:
                ray.cancel(job, force=True)

    return produce


BACKENDS: dict[str, Callable[[Simulator], Produce]] = {"local": local, "ray": on_ray}
