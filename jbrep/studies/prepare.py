"""The data sets and encoders that a study's runs need."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from jbrep.collecting import collect
from jbrep.collecting.collector import usual_shard_episodes
from jbrep.collecting.policies import Policy
from jbrep.dataset import Dataset, DataSettings, ScaledDataset
from jbrep.dataset.manifest import MANIFEST, read_manifest
from jbrep.dataset.settings import TRAINED, parts_of
from jbrep.encoders import FULL
from jbrep.encoders.shipped import UNLEARNED, find, names
from jbrep.envs.names import INSTANCE, Known, is_code
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError
from jbrep.evaluation.diagnosis import write
from jbrep.evaluation.evaluation import EVALUATION, Evaluation
from jbrep.machine import cores
from jbrep.methods.fit import Fitter
from jbrep.methods.registry import get_method
from jbrep.play.sources import find_good_policy, find_player, find_policy
from jbrep.pool import KILLED, side_by_side
from jbrep.records.document import read_document
from jbrep.records.storage import exists
from jbrep.rl import Run
from jbrep.studies.config import Data, data_key
from jbrep.studies.plan import Plan
from jbrep.studies.representations import ByName
from jbrep.text import slug

EVALUATIONS = "evaluations"  # the folder of those that a study makes


def check(plan: Plan) -> None:
    """Check, before anything is collected or trained, that the runs can start."""
    for each in every_made(plan):
        if each.data.folder:
            given = Dataset(each.folder).task
            check_same(plan.study.task(each.task), given, f"the data set {each.folder}")
            each.fitter()
        else:
            each.to_collect()
    for name in plan.study.tasks:
        task = plan.study.task(name)
        if task.id.startswith(INSTANCE):
            raise InputError(
                f"{task.id} exists in this process alone, not in those of runs: give its class"
            )
        for representation in by_name(plan):
            _check_by_name(plan, representation, task)
    _check_own(plan)
    _check_reference(plan)
    of_each = {(cell.task, repr(cell.learner)): cell for cell in plan.cells}
    for cell in of_each.values():  # the representation decides no setting of a learner
        run = plan.run(cell).replace(encoder=FULL)
        run.settings(run.find_encoder())


def by_name(plan: Plan) -> list[ByName]:
    """The representations that the study makes, or that ship."""
    return [each for each in plan.study.observed if isinstance(each, ByName)]


def _check_by_name(plan: Plan, representation: ByName, task: Task) -> None:
    """Check that an encoder ships for a task, or can be made for it."""
    largest = get_method(representation.kind).largest(task.size)
    if plan.study.data is not None:
        if largest is not None and representation.training.get("latent", 0) > largest:
            raise InputError(
                f"{representation.name} has more numbers than the {task.size} features of "
                f"{task.name} allow: choose a latent size of at most {largest}"
            )
    elif representation.name in UNLEARNED:
        find(representation.name, task)  # may refuse the task
    elif representation.name not in (shipped := names(task) or (FULL,)):
        raise InputError(
            f"no encoder {representation.name!r} ships for {task.name}: choose one of "
            f"{', '.join(shipped)}, or let the study train it, on the states that [data] gives"
        )


def _check_own(plan: Plan) -> None:
    """Check the user's own encoders, each once for each task."""
    checked = set()
    for cell in plan.cells:
        if isinstance(cell.representation, ByName):
            continue
        try:
            run = plan.run(cell)
            if (cell.task, run.encoder) not in checked:
                checked.add((cell.task, run.encoder))
                _check_encoder(run)
        except InputError as error:
            raise InputError(f"run {cell.name} can't start: {error}") from None


def _check_reference(plan: Plan) -> None:
    """Check that the policy that scores 1 can play one of the tasks; others have no score then."""
    problem, named = None, plan.study.verdicts.policy
    for task in map(plan.study.task, plan.study.tasks if named else ()):
        try:
            find_player(named, task).begin(task, [0])
            return
        except InputError as error:
            problem = problem or InputError(f"verdicts.reference can't play {task.name}: {error}")
    if problem:
        raise problem


def _check_encoder(run: Run) -> None:
    if not is_code(run.encoder) and not exists(run.encoder):
        raise InputError(f"its encoder {run.encoder} is missing")
    encoder = run.find_encoder()
    if is_code(run.encoder) and run.find_encoder().fingerprint != encoder.fingerprint:
        raise InputError(
            f"{run.encoder} makes another encoder each time: let it load its weights, or seed it"
        )


@dataclass(frozen=True)
class NeededData:
    """A data set that a study needs for a task, and the encoders that are made from it.

    Attributes:
        plan: the study.
        task: its name.
        name: of the data; empty for those of the only table.
        number: of several data sets.
    """

    plan: Plan = field(compare=False)
    task: str
    name: str
    number: int

    def __str__(self) -> str:
        several = f", set {self.number}" if self.plan.study.sets(self.name) > 1 else ""
        return f"{data_key(self.name)} of {self.task}{several}"

    @property
    def data(self) -> Data:
        """What the study says of it."""
        return self.plan.study.named_data[self.name]

    @property
    def folder(self) -> Path:
        """Where it is."""
        if self.data.folder:
            return self.data.existing(self.task)
        return self.plan.data(self.task, self.number, self.name)

    @property
    def is_complete(self) -> bool:
        """Whether it exists, or is collected to its end."""
        if self.data.folder:
            return True
        if not exists(self.folder / MANIFEST):
            return False
        there = read_manifest(self.folder)
        wanted = self.to_collect()[0].replace(shard_episodes=there.settings.shard_episodes)
        return there.complete and there.settings == wanted  # or it is refused where it is made

    @property
    def is_made(self) -> bool:
        """Whether it is complete, and its encoders are trained to the end."""
        if not self.is_complete:
            return False
        fitter = self.fitter()
        return all(
            fitter.plan(kind, name=name, **settings).is_complete()
            for name, kind, settings in self.fits()
        )

    def fits(self) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
        """Names, kinds and settings of the encoders that are made from it."""
        study = self.plan.study
        for each in by_name(self.plan):
            if study.data_of(each) == self.name:
                for name, settings in each.fits[self.number :: study.sets(self.name)]:
                    yield name, each.kind, settings

    def fitter(self) -> Fitter:
        """What makes its encoders, which are checked."""
        fitter = Fitter(self.folder, self.plan.encoders(self.task))
        for name, kind, settings in self.fits():
            try:
                fitter.plan(kind, name=name, **settings)
            except InputError as error:
                raise InputError(f"{name} can't be trained for {self.task}: {error}") from None
        return fitter

    def policy(self) -> Policy:
        """The policy that collects it; that of a run stays as the data set has it."""
        task = self.plan.study.task(self.task).undisturbed
        try:
            policy = find_policy(self.data.policy, self.folder, task)
            policy.begin(task, [0])  # may refuse the task
        except InputError as error:
            raise InputError(f"{data_key(self.name)}.policy for {self.task}: {error}") from None
        return policy

    def to_collect(self) -> tuple[DataSettings, Policy]:
        """Its settings, with states where the task has them, and its policy."""
        task, policy = self.plan.study.task(self.task).undisturbed, self.policy()
        settings = DataSettings(
            task=task,
            policy=policy.settings(),
            steps=self.data.steps,
            seed=self.data.seed + self.number,
            store_state=bool(task.state),
        )
        return settings, policy

    def make(self, threads: int | None) -> None:
        """Collect it on some threads, and train its encoders; None takes every core."""
        if not self.is_complete:
            settings, policy = self.to_collect()
            episodes = usual_shard_episodes(settings, self.folder, policy)
            settings = settings.replace(shard_episodes=episodes)
            collect(settings, self.folder, num_threads=threads, policy=policy)
            say(f"{self}: {read_manifest(self.folder).rows:,} states")
        fitter = self.fitter()
        for name, kind, given in self.fits():
            if fitter.fit(kind, name=name, **given).is_new:
                say(f"{self}: encoder {name}")

    def evaluate(self) -> None:
        """Evaluate its encoders on it, where that wasn't done."""
        fitter, place = self.fitter(), (slug(self.task), self.name, f"set-{self.number}")
        path = self.plan.folder.joinpath(EVALUATIONS, *place, EVALUATION)
        files = {n: fitter.plan(kind, name=n, **given).path for n, kind, given in self.fits()}
        files.pop(FULL, None)
        known = read_document(path, Evaluation).encoders if exists(path) else {}
        if files.keys() - known.keys():
            path.unlink(missing_ok=True)  # encoders may have been added
            data = ScaledDataset.of(self.folder)
            policy = find_good_policy(None, data.task, bool(data.dataset.manifest.settings.reward))
            write(files, data, path.parent, policy)
            say(f"{self}: its encoders are evaluated in {path.parent}")


def every_made(plan: Plan) -> list[NeededData]:
    """All data sets of a study."""
    return [
        NeededData(plan, task, name, number)
        for task in plan.study.tasks
        for name in plan.study.named_data
        for number in range(plan.study.sets(name))
    ]


def policies(plan: Plan) -> dict[str, str]:
    """SHA-256 of the files of policies that will collect data or score 1, as `Plan.policies`."""
    return plan.reference | {
        f"{each.folder.relative_to(plan.folder)}/{part['file']}": part["sha256"]
        for each in every_made(plan)
        if not each.data.folder
        for part in parts_of(each.policy().settings())
        if part["kind"] == TRAINED
    }


def say(line: str) -> None:
    """Print a line on standard error; a study goes on where that fails."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)


def prepare(plan: Plan, workers: int = 1) -> None:
    """Collect the data sets and train the encoders that don't exist yet; evaluate these if asked.

    What is made doesn't depend on how many workers make it. Stopped, it goes on where it was.

    Args:
        plan: the study.
        workers: how many processes go on at a time.
    """
    _make_all([each for each in every_made(plan) if not each.is_made], workers, plan.known)
    for each in every_made(plan) if plan.study.evaluate else ():
        each.evaluate()


def _make_all(waiting: Sequence[NeededData], workers: int, known: Known) -> None:
    workers = min(workers, cores(), len(waiting))
    if workers < 2:
        for each in waiting:
            each.make(None)
        return
    jobs = iter(waiting)
    make = partial(_make, max(1, cores() // workers), known)
    with closing(side_by_side(make, lambda: next(jobs, None), workers)) as made:
        for each, mistake in made:
            if mistake:
                raise InputError(mistake)
            if mistake is None:
                raise InputError(f"the worker that makes {each} {KILLED} `workers`")


def _make(threads: int, known: Known, made: NeededData) -> str:
    """Make a data set and its encoders, in a worker; what a user did wrong."""
    try:
        known.take()
        made.make(threads)
        return ""
    except InputError as error:
        return str(error)
