"""Which runs of a study go on together, to keep all workers busy, and how long that takes."""

import heapq
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.envs.names import is_code
from jbrep.errors import InputError
from jbrep.machine import cores, memory
from jbrep.progress import Progress
from jbrep.rl import Run
from jbrep.rl.cohort.replay import memory_of
from jbrep.rl.overrides import is_off_policy
from jbrep.rl.run import trainer_of
from jbrep.rl.settings import COHORT, CPU, CUDA
from jbrep.rl.speed import estimate
from jbrep.stats.power import Prospect, prospects
from jbrep.study.costs import Cost, costs
from jbrep.study.plan import Cell, Plan
from jbrep.study.prepare import check
from jbrep.study.representations import ByCode, ByName

Pack = tuple[Cell, ...]
_Groups = defaultdict[tuple[str, str, int], list[Cell]]  # by their kind, and what they observe

# wider cohorts don't cost each of their agents less on a CPU
_WIDEST = {CPU: 16, CUDA: 64}  # agents; for a GPU not measured yet
_OVERHEAD = 0.3  # what a step costs besides its agents, in what it costs for each
_SHARE = 0.7  # of the machine's memory, that replay buffers and environments may take
_OF_WORKER, _OF_AGENT = 1 << 29, 1 << 25  # bytes that they take besides


def usual_workers(plan: Plan) -> int:
    """How many packs go on at a time: one for each core, or one that has a GPU and all cores."""
    return cores() if plan.device == CPU else 1


def packed(plan: Plan, workers: int, width: int | None = None) -> list[Pack]:
    """The runs to go in packs, one for a worker at a time: the longest first, then the first.

    Runs of one task and learner can be in one pack if their trainer is the cohort; those that
    observe more numbers than their task has, only with others that observe as many. The number of
    runs in a pack is that with which the last worker ends earliest.

    Args:
        plan: of the study.
        workers: how many packs go on at a time.
        width: the most runs in a pack; by default as many as memory holds, and no more than pay.
    """
    unfinished = plan.unfinished
    groups, alone = _grouped(plan, unfinished)
    choices = range(_widest(plan, workers, width, groups, alone), 0, -1)
    each = [alone + [p for group in groups.values() for p in _split(group, n)] for n in choices]
    best = min(each, key=lambda packs: until_done([len(p) + _OVERHEAD for p in packs], workers))
    place = {cell.name: number for number, cell in enumerate(unfinished)}
    return sorted(best, key=lambda pack: (-len(pack), place[pack[0].name]))


def _grouped(plan: Plan, cells: Iterable[Cell]) -> tuple[_Groups, list[Pack]]:
    """The runs that can be in one pack with others, and those that can't, each by itself."""
    groups, alone = _Groups(list), list[Pack]()
    observed = dict[tuple[str, str], int]()  # by task and representation
    for cell in cells:
        if trainer_of(cell.learner, plan.study) == COHORT:
            seen = cell.task, cell.representation.name
            if seen not in observed:
                observed[seen] = _observed(plan, cell)
            groups[*cell.kind, observed[seen]].append(cell)
        else:
            alone.append((cell,))
    return groups, alone


def _widest(
    plan: Plan, workers: int, width: int | None, groups: _Groups, alone: Iterable[Pack]
) -> int:
    """The most runs that a pack may have, by memory and by what pays."""
    widest = _WIDEST[plan.device]
    limits = (_most(plan, workers, group[0], size) for (_, _, size), group in groups.items())
    most = min(limits, default=width or widest)
    of_alone = [
        _most(plan, workers, cell, _observed(plan, cell))
        for cell in {cell.kind: cell for (cell,) in alone}.values()
        if is_off_policy(cell.learner.algorithm)
    ]
    if min([most, *of_alone]) < 1 < workers:
        raise InputError(
            f"this machine's memory doesn't hold an agent for each of {workers} workers: give "
            "fewer --workers"
        )
    if width and width > most:
        raise InputError(
            f"the width is {width}: {workers} cohorts of {most} agents are the most that this "
            "machine's memory holds"
        )
    return width or min(widest, max(most, 1))


def _most(plan: Plan, workers: int, cell: Cell, observed: int) -> int:
    """How many runs like this one memory holds, for each worker."""
    run = plan.run(cell)
    robots = run.learner.hyperparameters.num_envs * plan.robot_memory(cell.task)
    of_each = memory_of(run, observed) + robots + _OF_AGENT
    return int((_SHARE * memory() / workers - _OF_WORKER) // of_each)


def _observed(plan: Plan, cell: Cell) -> int:
    """Numbers that a cohort has for each observation of a run: those of its task at least."""
    run, seen = plan.run(cell), cell.representation
    size = int(seen.training.get("latent", 0)) if isinstance(seen, ByName) else 0
    with suppress(InputError):  # the study has yet to make it
        size = run.find_encoder().latent_size
    return max(run.task.size, size)


def _split(group: Sequence[Cell], most: int) -> list[Pack]:
    """Packs of about the same size, the larger ones first."""
    parts = np.array_split(range(len(group)), -(-len(group) // most))
    return [tuple(group[number] for number in part) for part in parts]


def until_done(durations: Iterable[float], workers: int) -> float:
    """When the last worker ends, if each takes the longest work that is left."""
    busy = [0.0] * workers
    for each in sorted(durations, reverse=True):
        heapq.heapreplace(busy, busy[0] + each)
    return max(busy)


class Forecast(NamedTuple):
    """What a study would do, and how long it would take."""

    runs: list[tuple[Cell, int, float]]  # to go: each with its cohort's number and time [s]
    done: int
    seconds: float  # on one core, besides data and encoders
    elapsed: float  # with so many workers [s]
    workers: int
    prospects: list[Prospect]  # of its claims
    made_first: list[Cost]  # data and encoders


def forecast(plan: Plan, workers: int | None = None, width: int | None = None) -> Forecast:
    """The runs to go, and how long they would take, estimated from a few steps of each learner.

    Args:
        plan: the study.
        workers: how many processes would go on at a time; by default as many as are usual.
        width: the most agents that would learn together in one.
    """
    check(plan)
    plan.check_folder()
    workers = workers or usual_workers(plan)
    packs = packed(plan, workers, width)
    examples = {_kind(pack): pack for pack in packs}
    seconds = {
        kind: estimate([_example(plan.run(cell)) for cell in pack])
        for kind, pack in Progress(
            examples.items(), desc="timing", unit="trial", delay=1, leave=False
        )
    }
    each = [seconds[_kind(pack)] for pack in packs]
    return Forecast(
        runs=[(cell, i + 1, each[i]) for i, pack in enumerate(packs) for cell in pack],
        done=len(plan.cells) - sum(map(len, packs)),
        seconds=sum(each),
        elapsed=until_done(each, workers),
        workers=workers,
        prospects=list(prospects(plan.study.planned, plan.study.units)),
        made_first=costs(plan),
    )


def _kind(pack: Pack) -> tuple[object, ...]:
    """What the duration of a pack depends on, whatever of its settings seeds draw."""
    own = [c.representation.name for c in pack if isinstance(c.representation, ByCode)]
    return pack[0].task, pack[0].learner.name, len(pack), tuple(own)


def _example(run: Run) -> Run:
    """A run that takes as long; an encoder that is no code need not exist yet, and costs little."""
    return run if is_code(run.encoder) else run.replace(encoder=FULL)
