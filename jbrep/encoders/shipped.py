"""Encoders that ship with the package, by name."""

from pathlib import Path

from jbrep.encoders.encoder import FULL, IDENTITY, Encoder
from jbrep.encoders.file import SUFFIX, load
from jbrep.encoders.names import EncoderName
from jbrep.errors import InputError
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import get_task

_FOLDER = Path(__file__).parent / "shipped"


def names(task: str) -> tuple[str, ...]:
    """Names of the encoders that ship for a task, by kind, the largest latent first.

    `full` is the identity, whose file is called after its kind.
    """
    stems = (path.name.removesuffix(SUFFIX) for path in (_FOLDER / task).glob(f"*{SUFFIX}"))
    shown = (FULL if stem == IDENTITY else stem for stem in stems)
    return tuple(sorted(shown, key=lambda name: EncoderName.parse(name).order))


def find(name: str | Path, task: str) -> Encoder:
    """The encoder that ships for a task under that name, or the one in a file.

    A shipped name takes precedence; write ./dae-8 for a file of that name.

    Raises:
        InputError: there is neither, the file can't be used, or it was made for another task.
    """
    if shipped := _shipped(name, get_task(task).name):
        return load(shipped)
    if not exists(name):
        raise InputError(
            f"no encoder {str(name)!r}: give a file, or one that ships for {task}: "
            f"{', '.join(names(task))}"
        )
    encoder = load(Path(name))
    encoder.check_task(get_task(task))
    return encoder


def find_alone(name: str, task: str | None) -> Encoder:
    """An encoder by name and task, or by its file alone.

    Raises:
        InputError: as `find`; or no task is given and there is no such file.
    """
    if task:
        return find(name, task)
    if not exists(name):
        raise InputError(f"no encoder at {name}: for one that ships, give its --task, too")
    return load(Path(name))


def source_of(name: str | Path, task: str | None) -> str:
    """Where `find` and `find_alone` take an encoder from: "dae-8, shipped", or the file's path."""
    return f"{name}, shipped" if task and _shipped(name, task) else str(name)


def _shipped(name: str | Path, task: str) -> Path | None:
    """The file that ships for a task under that name, if there is one."""
    stem = IDENTITY if str(name) == FULL else str(name)
    known = stem == IDENTITY or stem in names(task)
    return _FOLDER / task / f"{stem}{SUFFIX}" if known else None
