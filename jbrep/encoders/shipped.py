"""Encoders by name: those that ship with the package, and those that need no data."""

import inspect
import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.coordinates import OBSERVATION, Coordinates, System, make_coordinates
from jbrep.coordinates.invariance import tried_coordinates
from jbrep.dataset import Scaler
from jbrep.dataset.scaling import usual_range
from jbrep.encoders.base import BaseEncoder, as_encoder
from jbrep.encoders.encoder import SUFFIX, Encoder, load
from jbrep.encoders.header import FULL, HELD_OUT_MSE, EncoderHeader, EncoderName
from jbrep.envs.names import code_named, is_code
from jbrep.envs.task import Task
from jbrep.errors import InputError, Notice, refusing
from jbrep.records.storage import exists

_FOLDER = Path(__file__).parent / "shipped"
UNLEARNED: dict[str, System] = {  # encoders that are made of any task, and what they are on
    FULL: OBSERVATION,
    "coordinates": "coordinates",
    "symmetry": "symmetry",
}
_SCALINGS = {  # of these, by the word for it in the header
    "ranges": "scaled by the usual ranges",
    "some ranges": "scaled by the usual ranges where they are known",
    "none": "unscaled",
}


def names(task: Task) -> tuple[str, ...]:
    """Names of the encoders that ship for a task, by kind, the largest latent first; often none."""
    return tuple(_files(task))


def unlearned(task: Task, name: str = FULL) -> Encoder:
    """A task's observation, or its coordinates or symmetry, by name, scaled as far as is known.

    The usual range of a number becomes [-1, 1]; one without keeps its physical units.
    """
    return _scaled(task, name, tried_coordinates(task, UNLEARNED[name]))


def _scaled(task: Task, name: str, coordinates: Coordinates | None) -> Encoder:
    features = coordinates.features if coordinates else task.features
    ranges = [usual_range(feature) for feature in features]
    known = sum(each is not None for each in ranges)
    scaling = "ranges" if known == len(features) else "some ranges" if known else "none"
    low, high = np.array([each or (-1, 1) for each in ranges], np.float32).T
    training, metrics = {"scaling": scaling}, {HELD_OUT_MSE: 0.0}
    header = EncoderHeader(
        kind=name, name=name, environment=task, training=training, metrics=metrics
    )
    return Encoder(header, Scaler(low, high, coordinates), (), ())


def find(name: Any, task: Task | str) -> BaseEncoder:
    """The encoder that ships for a task, or a task's name, under that name, or the one in a file.

    A shipped name takes precedence; write ./dae-8 for a file of that name. `full`, `coordinates`
    and `symmetry` are there for every task whose features allow them (see `unlearned`). A name such
    as mymodule:MyEncoder is of code (see `make`); anything but a name is an encoder itself, or a
    user's own (see `jbrep.encoders.base.OwnEncoder`).
    """
    if isinstance(task, str):
        from jbrep.envs.description import describe  # imports Gymnasium

        task = describe(task)
    if not isinstance(name, (str, Path)):
        return as_encoder(name, task)
    if is_code(name):
        return make(name, task)
    if _is_made(name, task):
        return unlearned(task, str(name))
    encoder = load(_path(name, task))
    encoder.check_task(task)
    header = encoder.header
    done, planned = (each.get("epochs") for each in (header.metrics, header.training))
    if done and planned and done < planned:
        warnings.warn(f"{name} is of {done} epochs of {planned} so far", Notice, stacklevel=2)
    return encoder


def make(name: str | Path, task: Task) -> BaseEncoder:
    """The encoder that code names: a class, or a function of no arguments, is called to make it."""
    with refusing(f"can't make the encoder {name}"):
        thing = code_named(str(name), "encoder")
        makes = isinstance(thing, type)
        if inspect.isfunction(thing):
            needed = (
                p for p in inspect.signature(thing).parameters.values() if p.default is p.empty
            )
            makes = all(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in needed)
        if makes:
            thing = thing()
    return as_encoder(thing, task)


def find_all(given: Any, task: Task) -> dict[str, BaseEncoder]:
    """Encoders, one or several as `find` takes them, by what tables call them.

    That is a name that the user gives in a dictionary, or else the encoder's own, or where it is
    from if that is taken.
    """
    if isinstance(given, (Mapping, list, tuple)) and not given:
        raise InputError("no encoder is given: give one, several, or several by names of yours")
    if isinstance(given, Mapping):
        return {label: find(each, task) for label, each in given.items()}
    several = given if isinstance(given, (list, tuple)) else [given]
    found = [find(each, task) for each in several]
    taken = Counter((FULL, *(each.name for each in found)))
    labels = [
        source_of(name, task).removesuffix(SUFFIX).removesuffix(", code")
        if taken[each.name] > 1 and isinstance(name, (str, Path))
        else each.name
        for name, each in zip(several, found, strict=True)
    ]
    if twice := [label for label, count in Counter(labels).items() if count > 1]:
        raise InputError(
            f"{twice[0]} is given twice: leave one out, or, in Python, give a dictionary by names"
        )
    return dict(zip(labels, found, strict=True))


def check_found(name: str, task: Task) -> None:
    """Make sure that there is an encoder of that name, without loading it."""
    if not is_code(name) and not _is_made(name, task):
        _path(name, task)


def _path(name: str | Path, task: Task) -> Path:
    path = _files(task).get(str(name)) or Path(name)
    if not exists(path):
        ships = ", ".join(names(task))
        raise InputError(
            f"no encoder {str(name)!r}: give a file, full, coordinates, symmetry"
            + (f", or one that ships for {task.name}: {ships}" if ships else "")
        )
    return path


def find_alone(name: Any, task: Task | None) -> BaseEncoder:
    """An encoder as `find` takes it, with its task, or by its file alone."""
    if task:
        return find(name, task)
    if isinstance(name, BaseEncoder):
        return name
    if is_code(name) or not isinstance(name, (str, Path)):
        raise InputError(
            f"{name} isn't a file, which would say what it observes: give its `task`, too"
        )
    if not exists(name):
        raise InputError(f"no encoder at {name}: for one that ships, give its `task`, too")
    return load(Path(name))


def source_of(name: str | Path, task: Task | None) -> str:
    """Where `find` takes an encoder from: "dae-8, shipped", "full, unscaled" or a file's path."""
    if is_code(name):
        return f"{name}, code"
    if task and _is_made(name, task):
        made = _scaled(task, str(name), make_coordinates(task, UNLEARNED[str(name)]))
        return f"{name}, {_SCALINGS[made.header.training['scaling']]}"
    return f"{name}, shipped" if task and str(name) in _files(task) else str(name)


def shipped(task: Task) -> dict[str, Encoder]:
    """The encoders that ship for a task, by their names, the whole observation first."""
    files = _files(task)
    return {name: load(files[name]) for name in sorted(files, key=lambda name: name != FULL)}


def shipped_folder(task: Task) -> Path:
    """Where those files are, if any ships."""
    return _FOLDER / task.slug


def _is_made(name: str | Path, task: Task) -> bool:
    """Whether the name is of an encoder that needs no data and doesn't ship for these features."""
    if str(name) not in UNLEARNED:
        return False
    if (path := _files(task).get(str(name))) is None:
        return True
    try:
        load(path).check_task(task)
    except InputError:
        return True
    return False


def _files(task: Task) -> dict[str, Path]:
    paths = shipped_folder(task).glob(f"*{SUFFIX}")
    files = {path.name.removesuffix(SUFFIX): path for path in paths}
    return dict(sorted(files.items(), key=lambda item: EncoderName.parse(item[0]).order))
