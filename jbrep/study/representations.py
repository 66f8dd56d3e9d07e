"""What the agents of a study observe: encoders by name, and the user's own, from files or code."""

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.encoders import FULL
from jbrep.encoders.code import is_code
from jbrep.encoders.encoder import IDENTITY
from jbrep.encoders.file import SUFFIX
from jbrep.encoders.names import check_name, of_seed
from jbrep.errors import InputError
from jbrep.methods.registry import Recipe, get_method, read_name
from jbrep.records.record import Record, from_plain
from jbrep.text import slug
from jbrep.training.settings import BatchSize, Epochs, LearningRate, NoiseDeviation, Seed

Given = str | Mapping[str, Any]  # a representation in a study's file: a name or a table

MAX_ENCODERS = 1000  # of one representation
_NAME = re.compile(r"[\w.-]{1,100}", re.ASCII)
_TASK, _SEED, _ENCODER = "{task}", "{seed}", "{encoder}"  # in a file's path, see ByFile


class _Training(Record, frozen=True, kw_only=True):
    """What a study may set of all encoders that it trains."""

    epochs: Epochs | None = None
    batch_size: BatchSize = None
    learning_rate: LearningRate | None = None
    noise: NoiseDeviation | None = None
    seed: Seed | None = None


@dataclass(frozen=True, kw_only=True)
class Representation(ABC):
    """What an agent observes.

    Attributes:
        name: what tables and folders call it.
        encoders: how many encoders of several training seeds the runs share: that of seed s has
            number s modulo this; None for one encoder.
    """

    name: str
    encoders: int | None = None

    @abstractmethod
    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        """The encoder of a run, as `jbrep.rl.Run` takes it.

        Args:
            task: name of the run's task.
            seed: of the run.
            made: folder of the encoders that the study trains for the task; None if it trains none.

        Raises:
            InputError: there is none for that task.
        """

    def settings(self, seed: int) -> dict[str, Any]:
        """What else a Run with that seed is told of its encoder."""
        number = self.number(seed)
        return {} if number is None else {"representation": self.name, "encoder_seed": number}

    def number(self, seed: int) -> int | None:
        """Which of several encoders a run with that seed has; None if there is one."""
        return None if self.encoders is None else seed % self.encoders

    def shares(self, seeds: Iterable[int]) -> list[int]:
        """How many of the runs with these seeds each of its encoders serves."""
        counts = Counter(self.settings(seed).get("encoder_seed") for seed in seeds)
        return [counts[i] for i in range(self.encoders)] if self.encoders else [*counts.values()]


class Fit(NamedTuple):
    """An encoder that the study trains."""

    number: int  # among the encoders of its representation
    settings: Mapping[str, Any]  # of its method


@dataclass(frozen=True, kw_only=True)
class ByName(Representation):
    """The whole observation, or an encoder that ships or that the study trains.

    Attributes:
        kind: of the encoder.
        training: settings of the encoder.
    """

    kind: str
    training: Mapping[str, Any]

    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        """As for `Representation`."""
        stem = self._stem(self.number(seed))
        return self.name if made is None else str(made / f"{stem}{SUFFIX}")

    @property
    def fits(self) -> dict[str, Fit]:
        """The encoders that the study trains, by their names."""
        if self.encoders is None:
            return {self._stem(None): Fit(0, self.training)}
        return {
            self._stem(number): Fit(
                number, {**self.training, "seed": number} if self.is_drawn else self.training
            )
            for number in range(self.encoders)
        }

    @property
    def is_drawn(self) -> bool:
        """Whether an encoder depends on a seed, and not on the data alone."""
        return get_method(self.kind).takes("seed")

    def _stem(self, number: int | None) -> str:
        name = IDENTITY if self.name == FULL else self.name
        return name if number is None else of_seed(name, number)


@dataclass(frozen=True, kw_only=True)
class Own(Representation):
    """An encoder of the user's, which tables call by a name of the user's."""

    def settings(self, seed: int) -> dict[str, Any]:
        """As for `Representation`."""
        return {"representation": self.name, **super().settings(seed)}


@dataclass(frozen=True, kw_only=True)
class ByFile(Own):
    """An encoder in a file.

    A path may contain {task}, the task's name as in folders, and either {seed}, a run's seed, or
    {encoder}, the number of the run's encoder. It may be a folder, which then holds
    TASK/NAME.safetensors or NAME.safetensors. Relative ones begin at the working directory.

    Attributes:
        paths: pairs of a task's name and its path; a name of None is of any task.
    """

    paths: tuple[tuple[str | None, str], ...]

    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        """As for `Representation`."""
        filled = self._pattern(task).replace(_TASK, slug(task)).replace(_SEED, str(seed))
        filled = filled.replace(_ENCODER, str(self.number(seed)))
        path = Path(filled).absolute()  # workers may have another working directory
        if not path.is_dir():
            return str(path)
        name = f"{self.name}{SUFFIX}"
        of_task = path / slug(task) / name
        return str(of_task if of_task.exists() else path / name)

    def settings(self, seed: int) -> dict[str, Any]:
        """As for `Representation`."""
        own = any(_SEED in path for _, path in self.paths)
        return super().settings(seed) | ({"encoder_seed": seed} if own else {})

    def _pattern(self, task: str) -> str:
        known = dict(self.paths)
        if not known.keys() & {task, None}:
            raise InputError(f"representation {self.name} has no file for {task}")
        return known.get(task) or known[None]


@dataclass(frozen=True, kw_only=True)
class ByCode(Own):
    """An encoder that code makes, named as module:Class.

    Attributes:
        code: its name.
    """

    code: str

    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        """As for `Representation`."""
        return self.code


def read_representation(given: Given, training: Mapping[str, Any]) -> Representation:
    """A representation as a study's file gives it.

    Args:
        given: full, the name of an encoder, such as dae-8, or a table with a name and one of: code;
            file; kind, with the settings of that method; or for several encoders of one, encoders,
            which may also stand beside file or kind.
        training: settings of encoders that the study trains, other than the usual.

    Raises:
        InputError: no such representation, or invalid settings.
    """
    if isinstance(given, str):
        method, said = read_name(given)
        return ByName(
            name=given, kind=method.name, training=_training(Recipe(method, said), training)
        )
    name = _name(given)
    try:
        return _of_table(name, {n: value for n, value in given.items() if n != "name"}, training)
    except InputError as error:
        raise InputError(f"representation {name}: {error}") from None


def name_of(given: Given) -> Any:
    """The name of a representation as a study's file gives it."""
    return given if isinstance(given, str) else given.get("name")


def _training(recipe: Recipe, training: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of an encoder: what all encoders of a study share, as far as it takes them."""
    from_plain(training, _Training, "training")
    taken = {key: value for key, value in training.items() if recipe.method.takes(key)}
    return {**taken, **recipe.given}


def _name(given: Mapping[str, Any]) -> str:
    name = given.get("name")
    is_name = isinstance(name, str) and _NAME.fullmatch(name) and name.strip(".")
    if not is_name or name == FULL:
        raise InputError(
            f"a representation's name is {name!r}: it must be of letters, digits, dots, hyphens "
            f"and underscores, and not {FULL}"
        )
    return str(name)


def _of_table(name: str, given: Mapping[str, Any], training: Mapping[str, Any]) -> Representation:
    encoders = given.get("encoders")
    if "encoders" in given and (type(encoders) is not int or not 1 <= encoders <= MAX_ENCODERS):
        raise InputError(f"encoders is {encoders!r}: it must be from 1 to {MAX_ENCODERS:,}")
    match {key: value for key, value in given.items() if key != "encoders"}:
        case {"file": file, **others} if not others:
            return ByFile(name=name, encoders=encoders, paths=_paths(file, encoders is not None))
        case {"code": code, **others} if not others and encoders is None:
            if not is_code(code):
                raise InputError(
                    f"its code is {code!r}, it must be text such as mymodule:MyEncoder"
                )
            return ByCode(name=name, code=code)
        case {"kind": kind, **settings} if "file" not in settings and "code" not in settings:
            return _trained(name, Recipe(get_method(kind), settings), encoders, training)
        case {**nothing} if not nothing and encoders is not None:
            return _trained(name, read_name(name), encoders, training)
    raise InputError(
        "it must have a name and one of file, code, kind (with settings) or encoders (a number)"
    )


def _trained(
    name: str, recipe: Recipe, encoders: int | None, training: Mapping[str, Any]
) -> ByName:
    """Encoders that the study trains, with settings of their own."""
    check_name(name)
    method, settings = recipe.method, _training(recipe, training)
    method.of(settings)
    if encoders is not None and "seed" in settings:
        raise InputError(f"its encoders have the seeds 0 to {encoders - 1}: leave out seed")
    return ByName(name=name, encoders=encoders, kind=method.name, training=settings)


def _paths(file: Any, are_several: bool) -> tuple[tuple[str | None, str], ...]:
    """The paths in the file of a representation: one, or a table of one for each task."""
    paths = tuple(file.items()) if isinstance(file, Mapping) else ((None, file),)
    for _, path in paths:
        if not isinstance(path, str) or not path:
            raise InputError(
                f"its file is {path!r}, it must be a path, or a table of paths by task"
            )
        known = (_TASK, _ENCODER if are_several else _SEED)
        words = re.findall(r"\{.*?\}", path)
        if _ENCODER in words and not are_several:
            raise InputError(f"say how many files {path} stands for, such as encoders = 5")
        if unknown := [word for word in words if word not in known]:
            raise InputError(
                f"unknown {unknown[0]} in its file {path}: only {' and '.join(known)} are known"
            )
        if are_several and _ENCODER not in words:
            raise InputError(f"its file {path} must contain {_ENCODER}, as there are several")
    return paths
