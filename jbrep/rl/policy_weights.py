"""A trained policy in one safe file: its weights, encoder and the settings that rebuild it.

The file is safetensors with a JSON header and a checksum; reading one runs nothing in it. Of the
network it has what acts, without critics.
"""

from pathlib import Path
from typing import Any

import torch

from jbrep.encoders import Encoder
from jbrep.encoders.file import unpack as unpack_encoder
from jbrep.errors import DamageError, InputError, check_version
from jbrep.records import container
from jbrep.records.storage import write_whole
from jbrep.rl.fields import check_policy, check_settings, completed
from jbrep.rl.files import POLICY_FORMAT
from jbrep.rl.policy import Trained, build
from jbrep.rl.weights import acting, fill, read_file

FORMAT_VERSION = 1
_WEIGHTS, _ENCODER = "policy.", "encoder."  # before the names of tensors


def save(trained: Trained, path: Path, run: str) -> None:
    """Write a policy's file, whole or not at all.

    Raises:
        InputError: as `pack`, or it can't be written.
    """
    write_whole(path, pack(trained, run))


def pack(trained: Trained, run: str) -> bytes:
    """The bytes of a policy's file.

    Args:
        trained: the policy of a run.
        run: what the run is called, a line.

    Raises:
        InputError: its encoder is code, which no file can hold.
    """
    if not isinstance(trained.encoder, Encoder):
        raise InputError(
            f"the policy of {run} can't be kept in a file: its encoder, {trained.encoder.name}, is "
            "code"
        )
    steps, settings = trained.step, dict(trained.settings)
    header = {
        "format": POLICY_FORMAT,
        "format_version": FORMAT_VERSION,
        "settings": settings,
        "encoder": trained.encoder.header.as_json(),
        "run": run,
        "step": settings["steps"] if steps is None else steps,
        "finished": steps is None,
    }
    tensors = {f"{_ENCODER}{name}": values for name, values in trained.encoder.tensors().items()}
    for name, values in acting(trained.policy).state_dict().items():
        tensors[f"{_WEIGHTS}{name}"] = values.numpy(force=True)
    if trained.statistics is not None:
        tensors |= trained.statistics.tensors
    return container.pack(tensors, header)


def load(path: Path) -> Trained:
    """Read a policy's file.

    Raises:
        InputError: no such file, another kind of file, or one of a newer jbrep.
        DamageError: it isn't what was written.
    """
    return unpack(read_file(path), path)[0]


def load_encoder(path: Path) -> Encoder:
    """The encoder in a policy's file.

    Raises:
        InputError: as `load`.
        DamageError: as `load`.
    """
    encoder = load(path).encoder
    assert isinstance(encoder, Encoder)  # `pack` takes no other
    return encoder


def unpack(raw: bytes, path: Path) -> tuple[Trained, dict[str, Any]]:
    """The policy in a file's bytes, and the file's header; the path is for messages.

    Raises:
        InputError: as `load`.
        DamageError: as `load`.
    """
    tensors, header = container.unpack(raw, path, "policy")
    if header.get("format") != POLICY_FORMAT:
        raise InputError(f"{path} is not a jbrep policy")
    check_version(path, header.get("format_version"), FORMAT_VERSION)
    check_policy(path, header)
    settings = completed(header["settings"])
    check_settings(path, settings)
    parts: dict[str, container.Tensors] = {
        part: {n.removeprefix(part): t for n, t in tensors.items() if n.startswith(part)}
        for part in (_WEIGHTS, _ENCODER)
    }
    encoder = unpack_encoder(path, parts[_ENCODER], dict(header["encoder"]))
    if encoder.fingerprint != settings["encoder"]:
        raise DamageError(f"{path} is damaged: its encoder isn't the one of its settings")
    trained = build(path, settings, encoder)
    weights = {name: torch.tensor(values) for name, values in parts[_WEIGHTS].items()}
    fill(acting(trained.policy), weights, path)
    step = None if header["finished"] else header["step"]
    return trained.with_statistics(tensors, path)._replace(step=step), header
