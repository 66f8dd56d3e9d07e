"""Policies in exported files, played as a robot would run them."""

from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from numpy.typing import NDArray

from jbrep.envs.recording import Actor, held
from jbrep.envs.task import Array, Task, check_same
from jbrep.errors import DamageError, InputError, first_line, refusing
from jbrep.play.player import Player
from jbrep.records.storage import read_file


class Described(msgspec.Struct):
    """What playing needs of what an exported policy says of itself."""

    environment: Task
    action_repeat: Annotated[int, Meta(ge=1)]


def read_exported(path: Path) -> tuple[Any, Described]:
    """The session of onnxruntime that computes a policy's actions, and what the file says of it.

    Raises:
        DamageError: it can't be read.
    """
    from jbrep.encoders.imported import session  # imports onnx

    what = f"{path} isn't an ONNX model that can be run"
    with refusing(what, told=first_line, kind=DamageError):
        made = session(read_file(path))
    text = made.get_modelmeta().custom_metadata_map.get("jbrep", "")
    try:
        return made, msgspec.json.decode(text, type=Described)
    except msgspec.DecodeError:  # also of a field that doesn't fit
        raise InputError(f"{path} isn't a policy that jbrep policy export wrote") from None


def exported_player(path: Path, task: Task | None = None) -> Player:
    """The policy in a file, to play its own task, maybe with another body or time limit."""
    session, said = read_exported(path)
    known = task or said.environment
    check_same(known, said.environment, str(path))
    ends = session.get_inputs(), session.get_outputs()
    if any(len(end) != 1 or len(end[0].shape) != 2 for end in ends):
        raise InputError(f"{path} isn't a policy that jbrep policy export wrote")
    (given,), (made,) = ends
    sizes = given.shape[1], made.shape[1]
    if sizes != (known.size, known.action_size):
        raise InputError(
            f"{path} takes {sizes[0]} numbers and gives {sizes[1]}, but {known.name} observes "
            f"{known.size} and acts by {known.action_size}: give its --task"
        )

    def act(observation: Array) -> NDArray[Any]:
        with refusing(f"{path} can't be run", told=first_line):
            (action,) = session.run([made.name], {given.name: observation.astype("float32")})
        return action

    def begin(task: Task, seeds: Any) -> Actor:
        return held(act, said.action_repeat)

    return Player(str(path), known, begin)
