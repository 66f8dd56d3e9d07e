"""policy.safetensors: a trained policy, its encoder and all settings of its run, in a safe file.

Reading one runs nothing in it, and needs no torch. A run's own also has what only training needs,
critics and targets, so that another run can begin with it; copies leave that out.
"""

import hashlib
from pathlib import Path
from typing import NamedTuple

from jbrep.encoders import Encoder
from jbrep.encoders.file import unpack as unpack_encoder
from jbrep.errors import DamageError, InputError
from jbrep.records import container
from jbrep.records.container import Tensors, without
from jbrep.records.document import document_from
from jbrep.records.storage import read_file
from jbrep.rl.files import PolicyHeader

ACTING, TRAINING, ENCODER = "policy.", "training.", "encoder."  # before the names of tensors


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
        """The encoder in it.

        Raises:
            DamageError: it isn't that of the settings.
        """
        settings = self.header.settings
        if self.header.encoder is None:
            raise InputError(f"{self.path} has no encoder: that of its run is code")
        encoder = unpack_encoder(self.path, without(ENCODER, self.tensors), self.header.encoder)
        if encoder.fingerprint != settings.encoder:
            raise DamageError(f"{self.path} is damaged: its encoder isn't the one of its settings")
        return encoder


def read(path: Path, sha256: str = "") -> PolicyFile:
    """Read a policy's file, whose SHA-256 may be known.

    Raises:
        DamageError: it isn't what was written, or the file with that hash.
    """
    raw = read_file(path)
    if sha256 and hashlib.sha256(raw).hexdigest() != sha256:
        raise DamageError(f"{path} is damaged or another run's: its SHA-256 isn't in run.json")
    return unpack(raw, path)


def unpack(raw: bytes, path: Path) -> PolicyFile:
    """The same of a file's bytes; the path is for messages."""
    tensors, header = container.unpack(raw, path, "policy")
    return PolicyFile(document_from(header, path, PolicyHeader), tensors, path)
