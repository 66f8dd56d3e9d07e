"""Where training has got to, in a file that runs nothing when it is read."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from jbrep.dae.training import Epoch, Trainer
from jbrep.dataset.storage import write_whole
from jbrep.errors import InputError

_KEY = "jbrep"


def save(trainer: Trainer, identity: Mapping[str, Any], path: Path) -> None:
    """Write the trainer's state, whole or not at all.

    Args:
        trainer: between two epochs.
        identity: what must be equal for training to go on: plain JSON.
        path: the file.
    """
    header = {"identity": identity, "history": trainer.history}
    content = safetensors.torch.save(_tensors(trainer), {_KEY: json.dumps(header)})
    write_whole(path, content)


def restore(trainer: Trainer, identity: Mapping[str, Any], path: Path) -> None:
    """Bring a new trainer to where the file's was; without a file it stays new.

    Raises:
        InputError: the file is damaged, or of other settings, data or versions.
    """
    if not path.exists():
        return
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        history = [Epoch(*map(float, epoch)) for epoch in header["history"]]
        there = header["identity"]
        if not isinstance(there, dict):
            raise TypeError("no settings in it")
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is damaged: delete it to begin anew ({error})") from None
    differing = [
        f"{name} {there.get(name)!r} there, {value!r} here"
        for name, value in identity.items()
        if there.get(name) != value
    ]
    if differing:
        raise InputError(
            f"{path} was begun otherwise: {', '.join(differing)}; take another --out, or delete it "
            "to begin anew"
        )
    _fill(trainer, tensors, path)
    trainer.history = history


def _tensors(trainer: Trainer) -> dict[str, Tensor]:
    """All that an epoch changes."""
    network = {f"network.{name}": p for name, p in trainer.network.state_dict().items()}
    best = {f"best.{name}": p for name, p in trainer.best.items()}
    moments = {
        f"adam.{i}.{name}": value
        for i, state in trainer.optimiser.state_dict()["state"].items()
        for name, value in state.items()
    }
    return {**network, **best, **moments}


def _fill(trainer: Trainer, tensors: dict[str, Tensor], path: Path) -> None:
    """Put a checkpoint's tensors in their places."""

    def under(prefix: str) -> dict[str, Tensor]:
        return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}

    optimiser = trainer.optimiser.state_dict()
    numbers = optimiser["param_groups"][0]["params"]
    optimiser["state"] = {i: under(f"adam.{i}.") for i in numbers}
    try:
        trainer.network.load_state_dict(under("best."))
        trainer.best = {name: p.clone() for name, p in trainer.network.state_dict().items()}
        trainer.network.load_state_dict(under("network."))
        trainer.optimiser.load_state_dict(optimiser)
    except (RuntimeError, KeyError, ValueError) as error:
        why = " ".join(str(error).split())
        raise InputError(f"{path} is damaged: delete it to begin anew ({why})") from None
