"""Policies of runs to collect data with, frozen as they are at the start."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from jbrep.dataset.settings import MAX_LETTERS, TRAINED
from jbrep.envs.recording import Actor
from jbrep.envs.task import Task, check_same
from jbrep.errors import DamageError, InputError
from jbrep.records.storage import exists, read_file
from jbrep.rl.files import ENCODER, PolicyHeader, is_policy_file
from jbrep.rl.policy import load_run
from jbrep.rl.policy_file import unpack
from jbrep.rl.trained import Trained, of_file, pack
from jbrep.text import printable


@dataclass(frozen=True)
class Frozen:
    """The policy of a run as a data set keeps it: in a file beside the shards.

    It acts deterministically, in one episode at a time: a network rounds differently in batches of
    other sizes, and on several threads.
    """

    file: str  # its name in the data set's folder
    content: bytes  # of the file

    def settings(self) -> dict[str, Any]:
        """What a manifest says of it."""
        header, _ = _opened(self.file, self.content)
        digest = hashlib.sha256(self.content).hexdigest()
        origin = {"run": header.run, "step": header.step}
        return {"kind": TRAINED, "file": self.file, "sha256": digest, **origin}

    def files(self) -> dict[str, bytes]:
        """The file that belongs to the data set."""
        return {self.file: self.content}

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        """Act deterministically; nothing is drawn."""
        header, trained = _opened(self.file, self.content)
        if task.id != trained.task.id:
            raise InputError(f"{header.run} is of {trained.task.name}, not of {task.name}")
        check_same(task, trained.task, header.run)
        return trained.one_by_one()


@lru_cache(maxsize=8)
def _opened(file: str, content: bytes) -> tuple[PolicyHeader, Trained]:
    policy = unpack(content, Path(file))
    return policy.header, of_file(policy)


def freeze(source: str, path: Path, file: str) -> Frozen:
    """The policy of a run, or of a policy's file, for a data set.

    Args:
        source: what manifests call it.
        path: the run's folder, or the file.
        file: name of the policy's file in the data set.

    Raises:
        DamageError: a file isn't what was written.
    """
    if is_policy_file(path):
        return Frozen(file, read_file(path))
    if not exists(path / ENCODER):
        raise InputError(
            f"{source} can't be collected with: its encoder is code, which can't be kept with the "
            "data"
        )
    return Frozen(file, pack(load_run(path), _line(source)))


def kept(source: str, path: Path) -> Frozen | None:
    """The policy that a data set has already in a file, if it is that of the source."""
    if not exists(path):
        return None
    found = Frozen(path.name, read_file(path))
    return found if found.settings()["run"] == _line(source) else None


def _line(source: str) -> str:
    """A run's folder as manifests name it."""
    return printable(str(Path(source)))[-MAX_LETTERS:]


def read_frozen(folder: Path, settings: Mapping[str, Any]) -> Frozen:
    """The policy that a manifest names.

    Raises:
        DamageError: it isn't the one that the data were collected with.
    """
    path = folder / settings["file"]
    frozen = Frozen(settings["file"], read_file(path))
    if frozen.settings() != settings:
        raise DamageError(f"{path} is damaged or another policy: its SHA-256 isn't in the manifest")
    return frozen
