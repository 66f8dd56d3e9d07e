"""What the agents of a study observe: encoders by name, and the user's own, from files or code."""

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jbrep.encoders import FULL
from jbrep.encoders.code import is_code
from jbrep.encoders.encoder import IDENTITY
from jbrep.encoders.file import SUFFIX
from jbrep.errors import InputError
from jbrep.methods.registry import read_name
from jbrep.methods.settings import read_setting
from jbrep.text import slug

Given = str | Mapping[str, Any]  # a representation in a study's file: a name or a table

_NAME = re.compile(r"[\w.-]{1,100}", re.ASCII)
_TRAINING = ("epochs", "batch_size", "learning_rate", "noise", "seed")  # settings of encoders
_TASK, _SEED = "{task}", "{seed}"  # in a file's path: the task's name as in folders, a run's seed


@dataclass(frozen=True)
class Representation(ABC):
    """What an agent observes.

    Attributes:
        name: what tables and folders call it.
    """

    name: str

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
        return {}


@dataclass(frozen=True)
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
        return self.name if made is None else str(made / f"{self.stem}{SUFFIX}")

    @property
    def stem(self) -> str:
        """The name of its encoder."""
        return IDENTITY if self.name == FULL else self.name


@dataclass(frozen=True)
class Own(Representation):
    """An encoder of the user's, which tables call by a name of the user's."""

    def settings(self, seed: int) -> dict[str, Any]:
        """As for `Representation`."""
        return {"representation": self.name}


@dataclass(frozen=True)
class ByFile(Own):
    """An encoder in a file.

    A path may contain {task} and {seed}, or be a folder, which then holds TASK/NAME.safetensors or
    NAME.safetensors. Relative ones begin at the working directory.

    Attributes:
        paths: pairs of a task's name and its path; a name of None is of any task.
    """

    paths: tuple[tuple[str | None, str], ...]

    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        """As for `Representation`."""
        pattern = self._pattern(task)
        filled = pattern.replace(_TASK, slug(task)).replace(_SEED, str(seed))
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


@dataclass(frozen=True)
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
        given: full, the name of an encoder, such as dae-8, or a table with a name and either file
            or code.
        training: settings of encoders that the study trains, other than the usual.

    Raises:
        InputError: no such representation, or invalid training settings.
    """
    return _by_name(given, training) if isinstance(given, str) else _own(given)


def name_of(given: Given) -> Any:
    """The name of a representation as a study's file gives it."""
    return given if isinstance(given, str) else given.get("name")


def _by_name(name: str, training: Mapping[str, Any]) -> ByName:
    method, given = read_name(name)
    for key, value in training.items():
        if key not in _TRAINING:
            raise InputError(f"unknown training.{key}: it must be one of {', '.join(_TRAINING)}")
        try:
            read_setting(key, value)
        except InputError as error:
            raise InputError(f"training.{error}") from None
    taken = {key: value for key, value in training.items() if key in method.defaults}
    return ByName(name, method.name, {**taken, **given})


def _own(given: Mapping[str, Any]) -> Own:
    name = given.get("name")
    is_name = isinstance(name, str) and _NAME.fullmatch(name) and name.strip(".")
    if not is_name or name == FULL:
        raise InputError(
            f"a representation's name is {name!r}: it must be of letters, digits, dots, hyphens "
            f"and underscores, and not {FULL}"
        )
    match {key: value for key, value in given.items() if key != "name"}:
        case {"file": file, **others} if not others:
            return ByFile(str(name), _paths(str(name), file))
        case {"code": code, **others} if not others:
            if not is_code(code):
                raise InputError(
                    f"representation {name}: its code is {code!r}, it must be text such as "
                    "mymodule:MyEncoder"
                )
            return ByCode(str(name), code)
    raise InputError(f"representation {name} must have a name and either file or code, not more")


def _paths(name: str, file: Any) -> tuple[tuple[str | None, str], ...]:
    """The paths in the file of a representation: one, or a table of one for each task."""
    paths = tuple(file.items()) if isinstance(file, Mapping) else ((None, file),)
    for _, path in paths:
        if not isinstance(path, str) or not path:
            raise InputError(
                f"representation {name}: its file is {path!r}, it must be a path, or a table of "
                "paths by task"
            )
        if unknown := [w for w in re.findall(r"\{.*?\}", path) if w not in (_TASK, _SEED)]:
            raise InputError(
                f"representation {name}: unknown {unknown[0]} in its file {path}: only {_TASK} and "
                f"{_SEED} are known"
            )
    return paths
