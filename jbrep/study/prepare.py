"""The data sets and encoders that a study's runs need."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from jbrep.collect import collect
from jbrep.collect.collector import usual_shard_episodes
from jbrep.collect.derive import derive
from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import MANIFEST, read_manifest
from jbrep.encoders import FULL
from jbrep.encoders.shipped import UNLEARNED, find, names
from jbrep.envs.names import is_code
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS
from jbrep.methods.fit import Fitter
from jbrep.methods.registry import get_method
from jbrep.records.storage import exists
from jbrep.rl import Run
from jbrep.study.config import Data
from jbrep.study.plan import Plan
from jbrep.study.representations import ByName
from jbrep.text import slug


def check(plan: Plan) -> None:
    """Check, before anything is collected or trained, that the runs can start.

    Raises:
        InputError: as `describe` for a task, as `DataSettings` for what is to be collected; no such
            shipped encoder, a latent size out of range, no data set of the task, or an encoder of
            the user's that can't be used.
    """
    data = plan.study.data
    for name in plan.study.tasks:
        task = plan.task(name)
        if data and data.folder:
            folder = _existing(data, name)
            check_same(task, Dataset(folder).task, f"the data set {folder}")
            _check_fits(plan, name, folder, 0)
        elif data:
            for number in range(data.sets):
                _to_collect(data, task, number)
        for each in _by_name(plan):
            largest = get_method(each.kind).largest(task.size)
            if data is None:
                _check_shipped(each, task)
            elif largest is not None and each.training.get("latent", 0) > largest:
                raise InputError(
                    f"{each.name} has more numbers than the {task.size} features of {name} allow: "
                    f"choose a latent size of at most {largest}"
                )
    _check_own(plan)
    of_each = {cell.kind: cell for cell in plan.cells}
    for cell in of_each.values():  # the representation decides no setting of a learner
        run = plan.run(cell).replace(encoder=FULL)
        run.settings(run.find_encoder())


def _by_name(plan: Plan) -> list[ByName]:
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


def prepare(plan: Plan) -> None:
    """Collect the data sets and train the encoders that don't exist yet.

    Raises:
        InputError: as `collect`, `derive` and `Fitter.fit`.
    """
    data = plan.study.data
    if data is None:
        return
    for task in plan.study.tasks:
        for number in range(data.sets):
            folder = _existing(data, task) if data.folder else _collect(plan, data, task, number)
            fitter = _check_fits(plan, task, folder, number)
            for name, kind, settings in _fits(plan, number):
                fitter.fit(kind, name=name, **settings)


def _check_fits(plan: Plan, task: str, folder: Path, number: int) -> Fitter:
    """Check that the encoders of a task can be made from a data set; what makes them."""
    fitter = Fitter(folder, plan.encoders(task))
    for name, kind, settings in _fits(plan, number):
        try:
            fitter.plan(kind, name=name, **settings)
        except InputError as error:
            raise InputError(f"{name} can't be trained for {task}: {error}") from None
    return fitter


def _fits(plan: Plan, number: int) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Names, kinds and settings of the encoders that are made from the data set of that number."""
    assert plan.study.data is not None
    for representation in _by_name(plan):
        for name, settings in representation.fits[number :: plan.study.data.sets]:
            yield name, representation.kind, settings


def _collect(plan: Plan, data: Data, task: str, number: int) -> Path:
    """Collect a task's data set; one for the Jitterbug's tasks, of which the others are derived."""
    folder = plan.data(task, number)
    collected = _collected(plan, number) if task in TASKS else task
    if task != collected:
        derive(plan.data(collected, number), task, folder)
    else:
        settings = _to_collect(data, plan.task(task), number)
        episodes = usual_shard_episodes(settings, folder)
        collect(settings.replace(shard_episodes=episodes), folder)
    return folder


def _to_collect(data: Data, task: Task, number: int) -> DataSettings:
    """The settings of the data set of that number, with states where the task has them."""
    seed = data.seed + number
    task = task.undisturbed
    return DataSettings(task=task, steps=data.steps, seed=seed, store_state=bool(task.state))


def _collected(plan: Plan, number: int) -> str:
    """The Jitterbug's task whose data are collected: those there with states, or the first's."""
    there = [name for name in TASKS if exists(plan.data(name, number) / MANIFEST)]
    with_states = (
        name for name in there if read_manifest(plan.data(name, number)).settings.store_state
    )
    first = next(name for name in plan.study.tasks if name in TASKS)
    return next(with_states, first)


def _existing(data: Data, task: str) -> Path:
    """The folder of an existing data set: the given one, or the task's within it."""
    folder = Path(data.folder)
    return folder if exists(folder / MANIFEST) else folder / slug(task)
