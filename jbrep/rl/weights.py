"""The weights in a stable-baselines3 zip file, read without running anything in it."""

import hashlib
import io
import pickletools
import textwrap
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.numpy
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from jbrep.errors import DamageError, InputError
from jbrep.records import storage

MAX_BYTES = 1 << 28  # of the file
STATISTICS = "observation_statistics.safetensors"  # by which an agent normalises what it sees
_MEMBER = "policy.pth"
_GLOBALS = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    "torch FloatStorage",
    "torch LongStorage",  # CrossQ counts the steps of its batch normalisation
}


class PolicyFile(NamedTuple):
    """What is read of a policy's file."""

    weights: dict[str, torch.Tensor]  # by the names of the policy's parameters
    tensors: dict[str, NDArray[Any]]  # the statistics of what it sees, if it has any


def read_policy(path: Path, sha256: str) -> PolicyFile:
    """The state dictionary of a policy, and the statistics by which it normalises what it sees.

    Args:
        path: a zip file that stable-baselines3 wrote.
        sha256: of the file.

    Raises:
        InputError: it can't be read.
        DamageError: it isn't the file with this hash, or holds no weights.
    """
    raw = read_file(path)
    if hashlib.sha256(raw).hexdigest() != sha256:
        raise DamageError(f"{path} is damaged or another run's: its SHA-256 isn't in run.json")
    try:
        members = _stored(raw)
        content = members.read(_MEMBER)
        archive = _stored(content)
        for name in archive.namelist():
            if name.endswith(".pkl"):
                _check_globals(archive.read(name))
        weights = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        return PolicyFile(dict(weights), _statistics(members))
    except Exception as error:  # zipfile and torch raise many types for a forged file
        raise DamageError(
            f"{path} is damaged, it holds no policy's weights: {one_line(error)}"
        ) from None


def fill(policy: BasePolicy, weights: Mapping[str, torch.Tensor], path: Path) -> None:
    """Put weights into a policy: all that it has, and no others.

    Args:
        policy: which they are of.
        weights: by the names of its parameters.
        path: of the file that they come from, for messages.

    Raises:
        InputError: they don't fit the policy.
        DamageError: a weight that the policy acts by is not finite.
    """
    try:
        policy.load_state_dict(weights)
    except (AttributeError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{path} doesn't fit the run's settings: {one_line(error)}") from None
    if not all(bool(torch.isfinite(part).all()) for part in acting(policy).parameters()):
        raise DamageError(f"{path} is damaged: the policy's weights are not finite")


def acting(policy: BasePolicy) -> BasePolicy:
    """The part of a policy that chooses actions: without critics where they are apart."""
    return getattr(policy, "actor", policy)


def read_file(path: Path) -> bytes:
    """All bytes of a policy's file.

    Raises:
        InputError: it is missing, not a regular file, or larger than a policy.
    """
    return storage.read_file(path, MAX_BYTES)


def statistics_in(raw: bytes) -> dict[str, NDArray[Any]]:
    """The statistics in a policy's zip file, of any compression; nothing if it has none.

    Raises:
        Exception: of many types, for a file that isn't one.
    """
    return _statistics(zipfile.ZipFile(io.BytesIO(raw)))


def _statistics(members: zipfile.ZipFile) -> dict[str, NDArray[Any]]:
    found = STATISTICS in members.namelist()
    return safetensors.numpy.load(members.read(STATISTICS)) if found else {}


def _stored(raw: bytes) -> zipfile.ZipFile:
    """A zip archive without compression, so that it can't grow when it is read."""
    archive = zipfile.ZipFile(io.BytesIO(raw))
    for member in archive.infolist():
        if member.compress_type != zipfile.ZIP_STORED:
            raise ValueError(f"{member.filename!r} is compressed")
    return archive


def _check_globals(content: bytes) -> None:
    """Make sure that a pickle names nothing but tensors and their dictionary.

    torch's own unpickler for weights allows more, such as a bytearray of any size.
    """
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name in ("GLOBAL", "STACK_GLOBAL", "INST") and argument not in _GLOBALS:
            raise ValueError(f"it names {argument!r}")


def one_line(error: Exception) -> str:
    """An error's text for a message."""
    return textwrap.shorten(str(error), 200)
