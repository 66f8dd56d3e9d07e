"""What a study would cost: its runs, data sets and encoders, each estimated from a short trial."""

import heapq
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from jbrep.collect.derive import derive
from jbrep.dataset.manifest import read_manifest
from jbrep.encoders import FULL
from jbrep.encoders.encoder import SUFFIX
from jbrep.encoders.header import of_seed
from jbrep.envs.names import is_code
from jbrep.methods.fit import Fitter
from jbrep.progress import Progress
from jbrep.records.storage import exists
from jbrep.rl import Run
from jbrep.rl.run import estimate
from jbrep.stats.power import Prospect, prospects
from jbrep.study.config import UNIFORM, data_key
from jbrep.study.plan import Cell, Plan
from jbrep.study.prepare import (
    Made,
    by_name,
    check,
    collect_made,
    folder_of,
    is_complete,
    made_for,
    source_of,
)
from jbrep.study.representations import ByCode, ByName
from jbrep.study.runner import usual_workers
from jbrep.training.method import Learned
from jbrep.training.trainer import default_batch_size

_STEPS = 2000  # of a trial, at first
_LONG_ENOUGH = 0.5  # seconds that it takes
_LEARNED_FROM = 0.8  # of a data set's rows
_EPOCHS = 3


class Cost(NamedTuple):
    """Data sets of a name, or encoders of a representation."""

    what: str
    to_go: int
    done: int
    seconds: float  # for those to go, on one core


class Forecast(NamedTuple):
    """What a study would do, and how long it would take."""

    runs: list[tuple[Cell, float]]  # to go, each with its time [s]
    done: int
    elapsed: float  # with so many workers [s]
    workers: int
    prospects: list[Prospect]  # of its claims
    made_first: list[Cost]  # data and encoders


def forecast(plan: Plan, workers: int | None = None) -> Forecast:
    """The runs to go, and how long they would take, estimated from a few steps of each learner.

    Args:
        plan: the study.
        workers: how many processes would go on at a time; by default as many as are usual.
    """
    check(plan)
    plan.check_folder()
    workers, cells = workers or usual_workers(plan), plan.unfinished
    examples = {_kind(cell): cell for cell in cells}
    seconds = {
        kind: estimate(_example(plan.run(cell)))
        for kind, cell in Progress(
            examples.items(), desc="timing", unit="trial", delay=1, leave=False
        )
    }
    each = [seconds[_kind(cell)] for cell in cells]
    return Forecast(
        runs=list(zip(cells, each, strict=True)),
        done=len(plan.cells) - len(cells),
        elapsed=until_done(each, workers),
        workers=workers,
        prospects=list(prospects(plan.study.planned, plan.study.units)),
        made_first=costs(plan),
    )


def until_done(durations: Iterable[float], workers: int) -> float:
    """When the last worker ends, if each takes the longest work that is left."""
    busy = [0.0] * workers
    for each in sorted(durations, reverse=True):
        heapq.heapreplace(busy, busy[0] + each)
    return max(busy)


def _kind(cell: Cell) -> tuple[object, ...]:
    """What the duration of a run depends on, whatever of its settings seeds draw."""
    own = cell.representation.name if isinstance(cell.representation, ByCode) else ""
    return cell.task, cell.learner.name, own


def _example(run: Run) -> Run:
    """A run that takes as long; an encoder that is no code need not exist yet, and costs little."""
    return run if is_code(run.encoder) else run.replace(encoder=FULL)


def costs(plan: Plan) -> list[Cost]:
    """What is made before the runs: data, each followed by the encoders that are made from them."""
    found = []
    for name, data in plan.study.named_data.items():
        with TemporaryDirectory() as folder:
            trial = _Trial(plan, name, Path(folder))
            found += [] if data.folder else [trial.of_data()]
            found += [
                trial.of_encoders(each)
                for each in by_name(plan)
                if plan.study.data_of(each) == name
            ]
    return found


class _Trial:
    """Few data of a name, in a folder of their own, and encoders that are hardly trained."""

    def __init__(self, plan: Plan, name: str, folder: Path):
        self._plan, self._there = plan, Plan(plan.study, folder)
        tasks = plan.study.tasks
        self._every = [each for task in tasks for each in made_for(plan, task) if each.name == name]
        self._rate = cache(self._seconds_per_row)

    def of_data(self) -> Cost:
        """What the data sets cost."""
        missing = [m for m in self._every if not is_complete(folder_of(self._plan, m), m)]
        seconds = sum(self._rate(each.task) * each.data.steps for each in missing)
        return Cost(
            data_key(self._every[0].name), len(missing), len(self._every) - len(missing), seconds
        )

    def of_encoders(self, representation: ByName) -> Cost:
        """What the encoders of a representation cost."""
        files = [
            self._plan.encoders(task) / f"{name}{SUFFIX}"
            for task in self._plan.study.tasks
            for name, _ in representation.fits
        ]
        ended = [
            exists(path) and not exists(path.with_suffix(".training") / "checkpoint.safetensors")
            for path in files
        ]
        to_go = ended.count(False)
        seconds = to_go * self._training(representation) if to_go else 0.0
        return Cost(representation.name, to_go, ended.count(True), seconds)

    def _made(self, task: str, steps: int) -> Made:
        """A small data set in place of one of the study's."""
        (first, *_) = (each for each in self._every if each.task == task)
        policy = first.data.policy if first.data.steps else UNIFORM
        return first._replace(
            data=first.data.replace(steps=steps, folder="", policy=policy, sets=None)
        )

    def _rows(self, task: str) -> int:
        """Rows of a data set that encoders are made from."""
        (first, *_) = (each for each in self._every if each.task == task)
        return first.data.steps or read_manifest(folder_of(self._plan, first)).rows

    def _seconds_per_row(self, task: str) -> float:
        """Of collecting a task's data, or of deriving them, judging by the last rows of a few."""
        source = source_of(self._there, self._made(task, _STEPS))
        if source and source.task != task:
            self._rate(source.task)
            folder = folder_of(self._there, self._made(task, _STEPS))
            start = time.perf_counter()
            rows = derive(folder_of(self._there, source), task, folder, num_threads=1).rows
            return (time.perf_counter() - start) / rows
        steps, before, wanted = _STEPS, 0, self._rows(task)
        while True:
            made, start = self._made(task, min(steps, wanted)), time.perf_counter()
            collect_made(self._there, made, 1)
            seconds = time.perf_counter() - start
            rows = read_manifest(folder_of(self._there, made)).rows
            if (before and seconds > _LONG_ENOUGH) or rows >= wanted:
                return seconds / max(rows - before, 1)
            steps, before = 4 * rows, rows

    def _training(self, representation: ByName) -> float:
        """Seconds that an encoder takes, on the data of the first task."""
        task, kind = self._plan.study.tasks[0], representation.kind
        self._rate(task)
        folder = folder_of(self._there, self._made(task, _STEPS))
        own = self._there.folder / "trial" / representation.name
        fitter, rows = Fitter(folder, own), self._rows(task)
        scale = rows / read_manifest(folder).rows
        _, settings = representation.fits[0]
        method = fitter.plan(kind, name=representation.name, **settings).method

        def seconds(number: int, **changes: int) -> float:
            start = time.perf_counter()
            fitter.fit(kind, name=of_seed("trial", number), **{**settings, **changes})
            return time.perf_counter() - start

        if not isinstance(method, Learned):
            seconds(0)  # which imports what it needs
            return scale * seconds(1)
        batch = settings.get("batch_size") or default_batch_size(round(_LEARNED_FROM * rows))
        batch = min(batch, round(_LEARNED_FROM * rows / scale))
        seconds(0, epochs=1, batch_size=batch)
        few, more = (seconds(n, epochs=n, batch_size=batch) for n in (1, 1 + _EPOCHS))
        epoch = max(more - few, 0.0) / _EPOCHS
        return scale * (max(few - epoch, 0.0) + method.epochs * epoch)
