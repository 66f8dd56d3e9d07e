"""The data sets and encoders that a study's runs need."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.collect import collect
from jbrep.collect.collector import usual_shard_episodes
from jbrep.collect.derive import derive
from jbrep.collect.policies import Policy, acts_on_observations
from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import MANIFEST, read_manifest
from jbrep.dataset.settings import TRAINED, parts_of
from jbrep.encoders import FULL
from jbrep.encoders.shipped import UNLEARNED, find, names
from jbrep.envs.names import import_modules, imported_modules, is_code
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS
from jbrep.machine import cores
from jbrep.methods.fit import Fitter
from jbrep.methods.registry import get_method
from jbrep.play.sources import find_policy
from jbrep.pool import ATTEMPTS, side_by_side
from jbrep.records.storage import exists
from jbrep.rl import Run
from jbrep.study.config import Data, Study, data_key
from jbrep.study.plan import Plan
from jbrep.study.representations import ByName
from jbrep.study.work import say


def check(plan: Plan) -> None:
    """Check, before anything is collected or trained, that the runs can start."""
    for name in plan.study.tasks:
        task = plan.task(name)
        for made in made_for(plan, name):
            if made.data.folder:
                folder = made.data.existing(name)
                check_same(task, Dataset(folder).task, f"the data set {folder}")
                _check_fits(plan, made, folder)
            else:
                _to_collect(plan, made)
        for each in by_name(plan):
            largest = get_method(each.kind).largest(task.size)
            if plan.study.data is None:
                _check_shipped(each, task)
            elif largest is not None and each.training.get("latent", 0) > largest:
                raise InputError(
                    f"{each.name} has more numbers than the {task.size} features of {name} allow: "
                    f"choose a latent size of at most {largest}"
                )
    _check_own(plan)
    of_each = {(cell.task, repr(cell.learner)): cell for cell in plan.cells}
    for cell in of_each.values():  # the representation decides no setting of a learner
        run = plan.run(cell).replace(encoder=FULL)
        run.settings(run.find_encoder())


def by_name(plan: Plan) -> list[ByName]:
    """The representations that the study makes, or that ship."""
    return [each for each in plan.study.observed if isinstance(each, ByName)]


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


def _check_encoder(run: Run) -> None:
    if not is_code(run.encoder) and not exists(run.encoder):
        raise InputError(f"its encoder {run.encoder} is missing")
    encoder = run.find_encoder()
    if is_code(run.encoder) and run.find_encoder().fingerprint != encoder.fingerprint:
        raise InputError(
            f"{run.encoder} makes another encoder each time: let it load its weights, or seed it"
        )


def _check_shipped(representation: ByName, task: Task) -> None:
    if representation.name in UNLEARNED:
        find(representation.name, task)  # may refuse the task
        return
    shipped = names(task) or (FULL,)
    if representation.name not in shipped:
        raise InputError(
            f"no encoder {representation.name!r} ships for {task.name}: choose one of "
            f"{', '.join(shipped)}, or let the study train it, on the states that [data] gives"
        )


class Made(NamedTuple):
    """A data set that the study needs for a task, and what it is made from."""

    task: str
    name: str  # of the data; empty for those of the only table
    data: Data
    number: int  # of several data sets

    def __str__(self) -> str:
        several = f", set {self.number}" if self.data.sets != 1 else ""
        return f"{data_key(self.name)} of {self.task}{several}"


def made_for(plan: Plan, task: str) -> list[Made]:
    """All data sets of a task."""
    sets = {name: plan.study.sets(name) for name in plan.study.named_data}
    return [
        Made(task, name, data.replace(sets=sets[name]), number)
        for name, data in plan.study.named_data.items()
        for number in range(sets[name])
    ]


def prepare(plan: Plan, workers: int = 1) -> None:
    """Collect the data sets and train the encoders that don't exist yet.

    What is made doesn't depend on how many workers make it. Stopped, it goes on where it was.

    Args:
        plan: the study.
        workers: how many processes go on at a time.
    """
    every = [each for task in plan.study.tasks for each in made_for(plan, task)]
    sources = {each: source_of(plan, each) for each in every}
    waiting = [each for each in every if not _is_made(plan, each)]
    waiting.sort(key=lambda each: sources[each] is not None)  # what others are derived from first
    workers = min(workers, cores(), len(waiting))
    threads = max(1, cores() // workers) if workers else 1
    if workers < 2:
        for each in waiting:
            _make(plan, each, sources[each], None)
        return
    under_way = set[Made]()

    def next_job() -> tuple[Made, Made | None] | None:
        missing = under_way.union(waiting)
        for each in waiting:
            if sources[each] not in missing:
                waiting.remove(each)
                under_way.add(each)
                return each, sources[each]
        return None

    make = partial(_work, plan.study, plan.folder, threads, imported_modules())
    with closing(side_by_side(make, next_job, workers)) as made:
        for (each, _), mistake in made:
            under_way.remove(each)
            if mistake:
                raise InputError(mistake)
            if mistake is None:
                raise InputError(
                    f"the worker that makes {each} was killed {ATTEMPTS} times, perhaps because "
                    "memory ran out: try fewer --workers"
                )


def _work(
    study: Study,
    folder: Path,
    threads: int,
    modules: Iterable[str],
    job: tuple[Made, Made | None],
) -> str:
    """As `_make`, in a worker; what a user did wrong."""
    try:
        import_modules(modules)
        _make(Plan(study, folder), *job, threads)
        return ""
    except InputError as error:
        return str(error)


def _make(plan: Plan, made: Made, source: Made | None, threads: int | None) -> None:
    """Collect or derive a data set, and train the encoders that are made from it."""
    folder = folder_of(plan, made)
    if not made.data.folder and not is_complete(folder, made):
        if source:
            derive(folder_of(plan, source), made.task, folder, num_threads=threads)
        else:
            collect_made(plan, made, threads)
        say(f"{made}: {read_manifest(folder).rows:,} states")
    fitter = _check_fits(plan, made, folder)
    for name, kind, settings in fits(plan, made):
        if fitter.fit(kind, name=name, **settings).is_new:
            say(f"{made}: encoder {name}")


def _is_made(plan: Plan, made: Made) -> bool:
    """Whether a data set is complete, and its encoders are trained to the end."""
    folder = folder_of(plan, made)
    if not (made.data.folder or is_complete(folder, made)):
        return False
    fitter = _check_fits(plan, made, folder)
    return all(
        fitter.plan(kind, name=name, **settings).is_complete()
        for name, kind, settings in fits(plan, made)
    )


def is_complete(folder: Path, made: Made) -> bool:
    """Whether a data set that is collected is there to its end."""
    if not exists(folder / MANIFEST):
        return False
    manifest = read_manifest(folder)
    return manifest.complete and manifest.settings.steps == made.data.steps


def folder_of(plan: Plan, made: Made) -> Path:
    """Where a data set is."""
    if made.data.folder:
        return made.data.existing(made.task)
    return plan.data(made.task, made.number, made.name)


def _check_fits(plan: Plan, made: Made, folder: Path) -> Fitter:
    """Check that the encoders of a task can be made from a data set; what makes them."""
    fitter = Fitter(folder, plan.encoders(made.task))
    for name, kind, settings in fits(plan, made):
        try:
            fitter.plan(kind, name=name, **settings)
        except InputError as error:
            raise InputError(f"{name} can't be trained for {made.task}: {error}") from None
    return fitter


def policies(plan: Plan) -> dict[str, str]:
    """SHA-256 of the files of policies that act in data that are collected, as `Plan.policies`."""
    return {
        f"{folder_of(plan, made).relative_to(plan.folder)}/{part['file']}": part["sha256"]
        for task in plan.study.tasks
        for made in made_for(plan, task)
        if not made.data.folder
        for part in parts_of(_policy(plan, made).settings())
        if part["kind"] == TRAINED
    }


def fits(plan: Plan, made: Made) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Names, kinds and settings of the encoders that are made from a data set."""
    for representation in by_name(plan):
        if plan.study.data_of(representation) == made.name:
            for name, settings in representation.fits[made.number :: plan.study.sets(made.name)]:
                yield name, representation.kind, settings


def source_of(plan: Plan, made: Made) -> Made | None:
    """What a data set is derived from; None where it is collected or exists.

    The Jitterbug's tasks share their motion, unless the policy acts on what it observes.
    """
    if made.task not in TASKS or made.data.folder:
        return None
    if acts_on_observations(_policy(plan, made).settings()):
        return None
    collected = _collected(plan, made)
    return None if collected == made.task else made._replace(task=collected)


def collect_made(plan: Plan, made: Made, threads: int | None) -> None:
    """Collect a data set on some threads; None takes one for each core."""
    folder, (settings, policy) = folder_of(plan, made), _to_collect(plan, made)
    episodes = usual_shard_episodes(settings, folder, policy)
    settings = settings.replace(shard_episodes=episodes)
    collect(settings, folder, num_threads=threads, policy=policy)


def _to_collect(plan: Plan, made: Made) -> tuple[DataSettings, Policy]:
    """The settings of a data set, with states where the task has them, and its policy."""
    task, policy = plan.task(made.task).undisturbed, _policy(plan, made)
    settings = DataSettings(
        task=task,
        policy=policy.settings(),
        steps=made.data.steps,
        seed=made.data.seed + made.number,
        store_state=bool(task.state),
    )
    return settings, policy


def _policy(plan: Plan, made: Made) -> Policy:
    """The policy that collects a data set; that of a run stays as the data set has it."""
    task = plan.task(made.task).undisturbed
    try:
        policy = find_policy(made.data.policy, folder_of(plan, made), task)
        policy.begin(task, [0])  # may refuse the task
    except InputError as error:
        raise InputError(f"{data_key(made.name)}.policy for {made.task}: {error}") from None
    return policy


def _collected(plan: Plan, made: Made) -> str:
    """The Jitterbug's task whose data are collected: those there with states, or the first's."""
    folders = {name: plan.data(name, made.number, made.name) for name in TASKS}
    there = [name for name, folder in folders.items() if exists(folder / MANIFEST)]
    with_states = (name for name in there if read_manifest(folders[name]).settings.store_state)
    first = next(name for name in plan.study.tasks if name in TASKS)
    return next(with_states, first)
