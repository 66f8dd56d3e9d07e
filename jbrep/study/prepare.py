"""The data sets and encoders that a study's runs need."""

from pathlib import Path

from jbrep.collect import collect
from jbrep.collect.derive import derive
from jbrep.dataset import Dataset, ScaledDataset, Settings
from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import find
from jbrep.errors import InputError
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import get_task
from jbrep.methods.fit import Fitter
from jbrep.study.config import Data
from jbrep.study.plan import Plan


def check(plan: Plan) -> None:
    """Check, before anything is collected or trained, that the runs will have their encoders.

    Raises:
        InputError: no such shipped encoder, a latent size out of range, or no data set.
    """
    study = plan.study
    for task in study.tasks:
        if study.data and study.data.folder:
            Dataset(_existing(study.data, task))
        for representation in plan.representations:
            if study.data is None:
                find(representation.encoder, task)
            elif (representation.training.latent or 0) >= get_task(task).size:
                raise InputError(
                    f"{representation.name} doesn't reduce the {get_task(task).size} features of "
                    f"{task}: choose a smaller latent size"
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
        folder = _data(plan, data, task)
        fitter = Fitter(ScaledDataset(Dataset(folder)), plan.encoders(task))
        for representation in plan.representations:
            fitter.fit(representation.kind, representation.training)


def _data(plan: Plan, data: Data, task: str) -> Path:
    """The folder of a task's data set: collected for the first task, derived for the others."""
    if data.folder:
        return _existing(data, task)
    first = plan.study.tasks[0]
    source = plan.folder / "data" / first
    if task == first:
        collect(Settings(task=task, steps=data.steps, seed=data.seed, store_state=True), source)
        return source
    derive(source, task, plan.folder / "data" / task)
    return plan.folder / "data" / task


def _existing(data: Data, task: str) -> Path:
    """The folder of an existing data set: the given one, or the task's within it."""
    folder = Path(data.folder)
    return folder if exists(folder / MANIFEST) else folder / task
