"""Checkpoints of training, in a file that runs nothing when it is read."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from msgspec import Meta
from torch import Tensor

from jbrep.errors import DamageError, InputError, differences
from jbrep.records import container
from jbrep.records.record import Record, from_plain, to_plain
from jbrep.training.trainer import Epoch, Trainer


class _Header(Record, frozen=True, kw_only=True):
    identity: dict[str, Any]  # what must be equal for training to resume
    history: Annotated[tuple[Epoch, ...], Meta(min_length=1)]


def save(trainer: Trainer, identity: Mapping[str, Any], path: Path) -> None:
    """Write a trainer's state after an epoch, with what must be equal to resume it, plain JSON."""
    tensors = {name: tensor.cpu().numpy() for name, tensor in _state(trainer).items()}
    header = _Header(identity=dict(identity), history=tuple(trainer.history))
    container.write(path, tensors, to_plain(header))


def restore(trainer: Trainer, identity: Mapping[str, Any], path: Path) -> None:
    """Put a trainer into the state that the file holds, in place of its own."""
    state = _state(trainer)
    tensors, header = container.read(path, "checkpoint")
    try:
        saved = from_plain(header, _Header)
    except InputError:
        raise _damaged(path) from None
    if differing := differences(saved.identity, identity):
        raise InputError(
            f"{path} belongs to another configuration: {differing}; choose another folder, or "
            "delete it to start over"
        )
    given = {name: torch.from_numpy(tensor) for name, tensor in tensors.items()}
    if _shapes(given) != _shapes(state):
        raise _damaged(path)
    for name, tensor in given.items():
        state[name].copy_(tensor)
    trainer.history = list(saved.history)


def _state(trainer: Trainer) -> dict[str, Tensor]:
    """Everything that an epoch changes, by name; the tensors are the trainer's own."""
    named = {f"network.{name}": p for name, p in trainer.objective.state_dict().items()}
    named |= {f"best.{name}": p for name, p in trainer.best.items()}
    for name, parameter in trainer.objective.named_parameters():
        named |= {
            f"adam.{name}.{key}": value for key, value in trainer.optimiser.state[parameter].items()
        }
    return named


def _shapes(tensors: dict[str, Tensor]) -> dict[str, Any]:
    return {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}


def _damaged(path: Path) -> DamageError:
    return DamageError(f"{path} is damaged: delete it to start over")
