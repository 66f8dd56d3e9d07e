"""What the agents of a study observe: encoders by name, and the user's own, from files or code."""

import re
from abc import abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from jbrep.encoders import FULL
from jbrep.encoders.encoder import SUFFIX
from jbrep.encoders.header import check_name, of_seed
from jbrep.envs.names import is_code
from jbrep.errors import InputError
from jbrep.methods.registry import get_method, read_name
from jbrep.records.record import Record, converted, from_plain, pattern
from jbrep.text import slug
from jbrep.training.method import Method
from jbrep.training.settings import BatchSize, Epochs, LearningRate, NoiseDeviation, Seed

Given = str | dict[str, Any]  # a representation in a study's file: a name or a table

MAX_ENCODERS = 1000  # of one representation
_TASK, _SEED, _ENCODER = "{task}", "{seed}", "{encoder}"  # in a file's path, see ByFile
_OwnName = Annotated[
    str,
    pattern(
        rf"\A(?!{FULL}\Z)(?=.*[^.])[A-Za-z0-9_.-]{{1,100}}\Z",
        f"1 to 100 letters of ASCII, digits, '_', '-' and '.', not only dots, and not {FULL}",
    ),
]


class _Training(Record, frozen=True, kw_only=True):
    """What a study may set of all encoders that it trains."""

    epochs: Epochs | None = None
    batch_size: BatchSize = None
    learning_rate: LearningRate | None = None
    noise: NoiseDeviation | None = None
    seed: Seed | None = None


class Representation(Record, frozen=True, kw_only=True):
    """What an agent observes.

    Attributes:
        name: what tables and folders call it.
        encoders: how many encoders of several training seeds the runs share: that of seed s has
            number s modulo this; None for one encoder.
    """

    name: str
    encoders: Annotated[int, Meta(ge=1, le=MAX_ENCODERS)] | None = None

    @abstractmethod
    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        """The encoder of a run, as `jbrep.rl.Run` takes it.

        Args:
            task: name of the run's task.
            seed: of the run.
            made: folder of the encoders that the study trains for the task; None if it trains none.
        """

    def encoder_seed(self, seed: int) -> int | None:
        """Which of several encoders a run with that seed has; None if all runs have the same."""
        return None if self.encoders is None else seed % self.encoders

    def shares(self, seeds: Iterable[int]) -> list[int]:
        """How many of the runs with these seeds each of its encoders serves."""
        counts = Counter(map(self.encoder_seed, seeds))
        return [counts[i] for i in range(self.encoders)] if self.encoders else [*counts.values()]


class ByName(Representation, frozen=True, kw_only=True):
    """The whole observation, or an encoder that ships or that the study trains.

    Attributes:
        kind: of the encoder.
        training: settings of the encoder.
        data: the name of the data that it is made from; None where that goes without saying.
    """

    kind: str
    training: dict[str, Any]
    data: str | None = None

    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        if made is None:
            return self.name
        name, _ = self.fits[self.encoder_seed(seed) or 0]
        return str(made / f"{name}{SUFFIX}")

    @property
    def fits(self) -> list[tuple[str, dict[str, Any]]]:
        """The name and settings of each encoder, in the order of their numbers."""
        if self.encoders is None:
            return [(self.name, self.training)]
        return [
            (of_seed(self.name, n), {**self.training, **({"seed": n} if self.is_drawn else {})})
            for n in range(self.encoders)
        ]

    @property
    def is_drawn(self) -> bool:
        """Whether an encoder depends on a seed, and not on the data alone."""
        return get_method(self.kind).takes("seed")


class ByFile(Representation, frozen=True, kw_only=True):
    """An encoder of the user's in a file.

    A path may contain {task}, the task's name as in folders, and either {seed}, a run's seed, or
    {encoder}, the number of the run's encoder. Relative ones begin at the working directory.

    Attributes:
        file: its path.
    """

    file: Annotated[str, Meta(min_length=1)]

    def check(self) -> None:
        path, words = self.file, set(re.findall(r"\{.*?\}", self.file))
        if _ENCODER in words and not self.encoders:
            raise InputError(f"say how many files {path} stands for, such as encoders = 5")
        known = (_TASK, _ENCODER if self.encoders else _SEED)
        if unknown := words - {*known}:
            raise InputError(
                f"unknown {min(unknown)} in its file {path}: only {' and '.join(known)} are known"
            )
        if self.encoders and _ENCODER not in words:
            raise InputError(f"its file {path} must contain {_ENCODER}, as there are several")

    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        filled = self.file.replace(_TASK, slug(task)).replace(_SEED, str(seed))
        filled = filled.replace(_ENCODER, str(self.encoder_seed(seed)))
        return str(Path(filled).absolute())  # workers may have another working directory

    def encoder_seed(self, seed: int) -> int | None:
        return seed if _SEED in self.file else super().encoder_seed(seed)


class ByCode(Representation, frozen=True, kw_only=True):
    """An encoder that the user's code makes.

    Attributes:
        code: its name, module:Class.
    """

    code: str

    def check(self) -> None:
        if not is_code(self.code):
            raise InputError(f"its code is {self.code!r}, it must be as in mymodule:MyEncoder")
        if self.encoders is not None:
            raise InputError("code makes one encoder: leave out encoders")

    def encoder(self, task: str, seed: int, made: Path | None) -> str:
        return self.code


def read_representation(given: Given, training: Mapping[str, Any]) -> Representation:
    """A representation as a study's file gives it.

    Args:
        given: full, the name of an encoder, such as dae-8, or a table with a name and one of: code;
            file; kind, with the settings of that method; or what a name doesn't say: encoders, how
            many there are, which may also stand beside file or kind, and data, of which they are
            made, which may stand beside kind.
        training: settings of encoders that the study trains, other than the usual.
    """
    if isinstance(given, str):
        method, own = read_name(given)
        return ByName(name=given, kind=method.name, training=_training(method, own, training))
    try:
        return _of_table(given, training)
    except InputError as error:
        raise InputError(f"representation {given.get('name', 'without a name')}: {error}") from None


def _of_table(given: Mapping[str, Any], training: Mapping[str, Any]) -> Representation:
    name: str = converted(given.get("name"), _OwnName, "name")
    beside = {key: given[key] for key in ("encoders", "data") if key in given}
    settings = {key: value for key, value in given.items() if key not in ("name", *beside)}
    match settings:
        case {"file": _}:
            return from_plain(given, ByFile)
        case {"code": _}:
            return from_plain(given, ByCode)
        case {"kind": str(kind), **rest}:
            method, own = get_method(kind), rest
        case _ if beside and not settings:
            method, own = read_name(name)
        case _:
            raise InputError(
                "it must have a name and one of file, code, kind (with settings), encoders (a "
                "number) or data"
            )
    check_name(name)
    fitted = _training(method, own, training)
    method.of(fitted)
    representation = ByName(name=name, kind=method.name, training=fitted, **beside)
    if representation.encoders is not None and "seed" in fitted:
        raise InputError(
            f"its encoders have the seeds 0 to {representation.encoders - 1}: leave out seed"
        )
    return representation


def _training(
    method: type[Method], own: Mapping[str, Any], training: Mapping[str, Any]
) -> dict[str, Any]:
    """The settings of an encoder: what all encoders of a study share, as far as it takes them."""
    from_plain(training, _Training, "training")
    taken = {key: value for key, value in training.items() if method.takes(key)}
    return {**taken, **own}
