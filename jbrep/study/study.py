"""A study from start to end, and an estimate of how long it takes."""

from collections import Counter
from contextlib import closing
from typing import NamedTuple

from jbrep.encoders import FULL
from jbrep.encoders.code import is_code
from jbrep.progress import Progress as Bar
from jbrep.records.lock import exclusive
from jbrep.records.storage import make_folder
from jbrep.rl import Run
from jbrep.rl.job import Job
from jbrep.rl.speed import estimate
from jbrep.stats.power import Prospect, prospects
from jbrep.study.packing import Pack, packed, until_done
from jbrep.study.plan import Cell, Plan
from jbrep.study.prepare import check, prepare
from jbrep.study.progress import Progress
from jbrep.study.registration import Registration, has_begun, register
from jbrep.study.representations import ByCode
from jbrep.study.runner import Backend
from jbrep.study.work import CRASHED


def run_study(plan: Plan, backend: Backend, workers: int, width: int | None = None) -> int:
    """Collect data, train encoders, and train every agent that hasn't been trained yet.

    A study that names primary cells is registered first, unless it has begun.

    `jbrep.study.results.conclude` then writes what came of it.

    Args:
        plan: the study.
        backend: what runs it.
        workers: how many processes go on at a time.
        width: the most agents that learn together in one.

    Returns:
        How many runs crashed.

    Raises:
        InputError: the folder holds another study, the study's settings can't be used, or memory
            doesn't hold as many agents.
    """
    check(plan)
    unfinished = plan.unfinished
    packs = packed(plan, unfinished, workers, width)
    make_folder(plan.folder)
    with exclusive(plan.folder):
        plan.write()
        if plan.study.rules.primary and not has_begun(plan.folder):
            register(plan.folder, plan.study, plan.fingerprints)
            plan = Plan(plan.study, plan.folder)  # its runs name the registration
        prepare(plan)
        for cell in plan.cells:  # so that any mistake shows before the first run
            Job(plan.run(cell), plan.folder_of(cell)).clear()
        if not unfinished:
            return 0
        statuses = Counter[str]()
        with (
            Progress(plan, unfinished) as progress,
            closing(backend(plan, packs, workers)) as outcomes,
        ):
            for outcome in outcomes:
                progress.report(outcome)
                statuses[outcome.status] += 1
    return statuses[CRASHED]


def register_study(plan: Plan) -> Registration:
    """Write down what is going to be run, before the first run.

    Raises:
        InputError: as `run_study`, or there are runs already.
    """
    check(plan)
    plan.write()
    return register(plan.folder, plan.study, plan.fingerprints)


class Forecast(NamedTuple):
    """What a study would do, and how long it would take."""

    runs: list[tuple[Cell, int, float]]  # to go: each with its cohort's number and time [s]
    done: int
    seconds: float  # on one core, besides data and encoders
    elapsed: float  # with so many workers [s]
    workers: int
    prospects: list[Prospect]  # of its primary cells


def forecast(plan: Plan, workers: int, width: int | None = None) -> Forecast:
    """The runs to go, and how long they would take, estimated from a few steps of each learner.

    Args:
        plan: the study.
        workers: how many processes would go on at a time.
        width: the most agents that would learn together in one.

    Raises:
        InputError: as `run_study`, as far as that is known beforehand.
    """
    check(plan)
    unfinished = plan.unfinished
    packs = packed(plan, unfinished, workers, width)
    examples = {_kind(pack): pack for pack in packs}
    seconds = {
        kind: estimate([_example(plan.run(cell)) for cell in pack])
        for kind, pack in Bar(examples.items(), desc="timing", unit="trial", delay=1, leave=False)
    }
    each = [seconds[_kind(pack)] for pack in packs]
    arms = {cell.label: plan.study.arms(cell.representation) for cell in plan.cells}
    return Forecast(
        runs=[(cell, i + 1, each[i]) for i, pack in enumerate(packs) for cell in pack],
        done=len(plan.cells) - len(unfinished),
        seconds=sum(each),
        elapsed=until_done(each, workers),
        workers=workers,
        prospects=list(prospects(plan.study.planned, arms)),
    )


def _kind(pack: Pack) -> tuple[object, ...]:
    """What the duration of a pack depends on."""
    own = [c.representation.name for c in pack if isinstance(c.representation, ByCode)]
    return pack[0].task, pack[0].learner.name, len(pack), tuple(own)


def _example(run: Run) -> Run:
    """A run that takes as long; an encoder that is no code need not exist yet, and costs little."""
    return run if is_code(run.encoder) else run.replace(encoder=FULL)
