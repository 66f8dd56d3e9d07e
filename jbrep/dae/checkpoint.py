"""Where training has got to, in a file that runs nothing when it is read."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from jbrep.dae.training import Epoch, Trainer
from jbrep.errors import InputError, differences
from jbrep.files import container


def save(trainer: Trainer, identity: Mapping[str, Any], path: Path) -> None:
    """Write the trainer's state, whole or not at all.

    Args:
        trainer: after at least one epoch.
        identity: what must be equal for training to go on: plain JSON.
        path: the file.
    """
    tensors = {name: tensor.cpu().numpy() for name, tensor in _state(trainer).items()}
    container.write(path, tensors, {"identity": identity, "history": trainer.history})


def restore(trainer: Trainer, identity: Mapping[str, Any], path: Path) -> None:
    """Bring a trainer to where the file's was; nothing of the trainer's own progress stays.

    Raises:
        InputError: the file is damaged, or of other settings, data or versions.
    """
    tensors, header = container.read(path, "checkpoint")
    try:
        differing = differences(dict(header["identity"]), identity)
        history = [Epoch(*map(float, epoch)) for epoch in header["history"]]
    except (KeyError, TypeError, ValueError, ArithmeticError):
        raise _damaged(path) from None
    if differing:
        raise InputError(
            f"{path} was begun otherwise: {differing}; take another folder, or delete it to begin "
            "anew"
        )
    if not history or not all(math.isfinite(loss) for epoch in history for loss in epoch):
        raise _damaged(path)
    state = _state(trainer)
    given = {name: torch.from_numpy(tensor) for name, tensor in tensors.items()}
    if _shapes(given) != _shapes(state):
        raise _damaged(path)
    for name, tensor in given.items():
        state[name].copy_(tensor)
    trainer.history = history


def _state(trainer: Trainer) -> dict[str, Tensor]:
    """All that an epoch changes, by name; the tensors are the trainer's own."""
    named = {f"network.{name}": p for name, p in trainer.network.state_dict().items()}
    named |= {f"best.{name}": p for name, p in trainer.best.items()}
    for name, parameter in trainer.network.named_parameters():
        named |= {
            f"adam.{name}.{key}": value for key, value in trainer.optimiser.state[parameter].items()
        }
    return named


def _shapes(tensors: dict[str, Tensor]) -> dict[str, Any]:
    return {name: (tensor.shape, tensor.dtype) for name, tensor in tensors.items()}


def _damaged(path: Path) -> InputError:
    return InputError(f"{path} is damaged: delete it to begin anew")
