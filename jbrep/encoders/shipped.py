"""Encoders that come with the package, by name."""

from pathlib import Path

from jbrep.encoders.encoder import Encoder
from jbrep.encoders.file import SUFFIX, load
from jbrep.errors import InputError
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import get_task

_FOLDER = Path(__file__).parent / "shipped"


def names(task: str) -> tuple[str, ...]:
    """Names of the encoders that ship for a task, by kind, the largest latent first."""

    def order(name: str) -> tuple[str, int]:
        kind, _, latent = name.partition("-")
        return kind, -int(latent or 0)

    found = (path.name.removesuffix(SUFFIX) for path in (_FOLDER / task).glob(f"*{SUFFIX}"))
    return tuple(sorted(found, key=order))


def find(name: str | Path, task: str) -> Encoder:
    """The encoder of a task that ships under that name, or the one in a file.

    A name that ships comes first; write ./dae-8 for a file that is called so.

    Raises:
        InputError: neither; or a file that can't be used, or one made for another task.
    """
    shipped = names(get_task(task).name)
    if str(name) in shipped:
        return load(_FOLDER / task / f"{name}{SUFFIX}")
    if not exists(name):
        raise InputError(
            f"no encoder {str(name)!r}: a file is needed, or one that ships for {task}: "
            f"{', '.join(shipped)}"
        )
    encoder = load(Path(name))
    encoder.check_task(get_task(task))
    return encoder


def find_alone(name: str, task: str | None) -> Encoder:
    """An encoder by name and task, or by its file alone.

    Raises:
        InputError: as `find`; or no task, and no such file.
    """
    if task:
        return find(name, task)
    if not exists(name):
        raise InputError(f"no encoder at {name}: of one that ships, the --task is needed, too")
    return load(Path(name))
