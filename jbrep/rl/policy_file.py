"""policy.safetensors: a trained policy, its encoder and all settings of its run, in a safe file.

Reading one runs nothing in it, and needs no torch. A run's own also has what only training needs,
critics and targets, so that another run can begin with it; copies leave that out. Some ship: the
best agent that was trained for each of the Jitterbug's tasks.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.encoders import Encoder
from jbrep.encoders.encoder import unpack as unpack_encoder
from jbrep.envs.task import Array, Task
from jbrep.errors import DamageError, InputError
from jbrep.records import container
from jbrep.records.container import Tensors, without
from jbrep.records.document import document_from
from jbrep.records.storage import exists, read_file
from jbrep.records.tables import Columns, count, finite, read_csv
from jbrep.rl.files import POLICY_SUFFIX, PolicyHeader

ACTING, TRAINING, ENCODING = "policy.", "training.", "encoder."  # before the names of tensors
SHIPPED = "trained"  # what commands call the one that ships for their task
FOLDER = Path(__file__).parent / "shipped"
RETURNS = "returns.csv"  # of the policies that ship, and of others
COLUMNS: Columns = {"task": str, "policy": str, "episode": count, "return": finite}

Returns = Mapping[str, Array]  # by policy, in the first episodes that every run is evaluated on


class PolicyFile(NamedTuple):
    """What a policy's file has."""

    header: PolicyHeader
    tensors: Tensors
    path: Path

    @property
    def weights(self) -> Tensors:
        """Of the part that acts, by the names of its parameters."""
        return without(ACTING, self.tensors)

    def encoder(self) -> Encoder:
        """The encoder in it."""
        settings = self.header.settings
        if self.header.encoder is None:
            raise InputError(f"{self.path} has no encoder: that of its run is code")
        encoder = unpack_encoder(self.path, without(ENCODING, self.tensors), self.header.encoder)
        if encoder.fingerprint != settings.encoder:
            raise DamageError(f"{self.path} is damaged: its encoder isn't the one of its settings")
        return encoder


def read(path: Path, sha256: str = "") -> PolicyFile:
    """Read a policy's file, whose SHA-256 may be known."""
    raw = read_file(path)
    if sha256 and hashlib.sha256(raw).hexdigest() != sha256:
        raise DamageError(f"{path} is damaged or another run's: its SHA-256 isn't in run.json")
    return unpack(raw, path)


def unpack(raw: bytes, path: Path) -> PolicyFile:
    """The same of a file's bytes; the path is for messages."""
    tensors, header = container.unpack(raw, path, "policy")
    return PolicyFile(document_from(header, path, PolicyHeader), tensors, path)


class Shipped(NamedTuple):
    """A policy that ships."""

    task: str
    observes: str  # as tables call it
    learner: str
    steps: int  # of training
    returns: Returns  # of this policy, SHIPPED, and of others by their names


def shipped_file(task: str) -> Path:
    """Where the policy for a task is, if one ships."""
    return FOLDER / f"{task}{POLICY_SUFFIX}"


def find_shipped(task: Task) -> Path:
    """The file of the policy that ships for a task, whatever its time limit and body."""
    path = shipped_file(task.slug)
    if not exists(path):
        ships = ", ".join(sorted(each.stem for each in FOLDER.glob(f"*{POLICY_SUFFIX}")))
        raise InputError(f"no {SHIPPED} policy ships for {task.name}: only for {ships}")
    return path


def shipped() -> list[Shipped]:
    """All policies that ship, with what they return."""
    returns: dict[str, dict[str, list[float]]] = {}
    for task, policy, _, value in read_csv(FOLDER / RETURNS, COLUMNS):
        returns.setdefault(task, {}).setdefault(policy, []).append(value)
    found = []
    for task, by_policy in returns.items():
        header = read(shipped_file(task)).header
        names = (header.settings.representation, header.settings.learner)
        every = {policy: np.array(values) for policy, values in by_policy.items()}
        found.append(Shipped(task, *names, header.step, every))
    return found
