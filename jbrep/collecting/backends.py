"""Where episodes are made: in this process, or in others."""

import math
import pickle
from collections import deque
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

from jbrep.collecting.shards import Growth, Produce, Simulator
from jbrep.dataset.schema import Columns
from jbrep.envs.make import close_kept, is_batched
from jbrep.envs.names import Known
from jbrep.envs.recording import Tick
from jbrep.errors import InputError, first_line, refusing
from jbrep.machine import cores
from jbrep.pool import KILLED, side_by_side, stop_requested

_PIECES = 10  # of a shard: what a worker makes at a time
_AHEAD = 4  # pieces for each worker, begun or held until those before are made
_PATIENCE = 60.0  # seconds, until pieces under way have stopped
Made = list[Columns | InputError]  # episodes, and what ended them early


def local(simulator: Simulator) -> Produce:
    """A batch's episodes in turn on threads; other environments' side by side in processes."""
    workers = simulator.num_threads or cores()
    task = simulator.settings.task
    known = Known.of([task])
    if is_batched(task) or workers == 1 or not _can_be_sent(known, simulator):
        return simulator.in_turn
    return _in_processes(replace(simulator, num_envs=1, num_threads=1), workers, known)


def _can_be_sent(*parts: Any) -> bool:
    """Whether other processes can make what this one has, though they don't run its script.

    They can't make classes of a script or notebook, which stand in `__main__`.
    """
    try:
        return b"__main__" not in pickle.dumps(parts)
    except Exception:  # some libraries raise their own
        return False


def _in_processes(simulator: Simulator, workers: int, known: Known) -> Produce:
    """Pieces made side by side, given in order; one whose worker is killed is made again."""

    def produce(growth: Growth, tick: Tick) -> Iterator[Columns]:
        each = simulator.settings.shard_episodes
        if not growth.wants((growth.episodes // each + 1) * each):  # one shard alone
            yield from simulator.in_turn(growth, tick)
            return
        begin, waiting, made = growth.episodes, deque[range](), dict[range, Made]()
        close_kept()  # the workers have their own

        def next_piece() -> range | None:
            nonlocal begin
            if waiting and (len(waiting) >= _AHEAD * workers or not growth.wants(begin)):
                return None
            most = (begin // each + 1) * each - begin  # a piece is of one shard
            piece = range(begin, begin + min(math.ceil(each / _PIECES), most))
            waiting.append(piece)
            begin = piece.stop
            return piece

        make, hint = partial(make_episodes, known, simulator), "try 1 of `threads`"
        with (
            refusing(f"other processes fail, {hint}", (BrokenExecutor,), describe=first_line),
            closing(side_by_side(make, next_piece, workers, _PATIENCE)) as pieces,
        ):
            for piece, result in pieces:
                if result is None:
                    begun = f"the worker that began with episode {piece.start}"
                    raise InputError(f"{begun} {KILLED} `threads`")
                made[piece] = result
                while waiting and waiting[0] in made:
                    yield from _whole(made.pop(waiting.popleft()))

    return produce


def make_episodes(known: Known, simulator: Simulator, episodes: range) -> Made:
    """Make some episodes of one shard, in a process of its own."""
    made: Made = []
    try:
        known.take()
        for block in simulator.made(episodes, _stop_on_request):
            made.append(block)
    except InputError as error:
        made.append(InputError(str(error)))  # which can be sent
    return made


def _whole(made: Made) -> Iterator[Columns]:
    for each in made:
        if isinstance(each, InputError):
            raise each
        yield each


def _stop_on_request(steps: int) -> None:
    if stop_requested():
        raise SystemExit
