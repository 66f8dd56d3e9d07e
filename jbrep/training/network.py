"""Networks of dense layers: the paper's, and others."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from jbrep.encoders import Layer
from jbrep.encoders.layers import AVG_L1_NORM, MAX_UNITS, activate
from jbrep.errors import InputError, choose


class AvgL1Norm(nn.Module):
    """Divides values (..., units) by their average magnitude."""

    def forward(self, values: Tensor) -> Any:
        return activate(AVG_L1_NORM, values)


_MODULES = {"relu": nn.ReLU, "tanh": nn.Tanh, AVG_L1_NORM: AvgL1Norm}
_SIZES = re.compile(r"[1-9][0-9]{0,8}([x,][1-9][0-9]{0,8})*")
HIDDEN = 64  # units of each of a predictor's two hidden layers
_NAMES = {module: name for name, module in _MODULES.items()}


@dataclass(frozen=True)
class Architecture:
    """The layers between observation and latent, and the default settings of training."""

    name: str  # paper, deep, linear, or the hidden sizes, as 64x64
    hidden: tuple[int, ...]  # widths from observation to latent, mirrored in the decoder; ReLU
    code: str  # activation of the latent
    output: str  # activation of the reconstruction
    epochs: int
    learning_rate: float
    decay: bool  # whether the learning rate falls to zero along a cosine


_DECAYING: dict[str, Any] = {"epochs": 12, "learning_rate": 2e-3, "decay": True}
ARCHITECTURES = {
    each.name: each
    for each in (
        Architecture("paper", (), "tanh", "tanh", epochs=200, learning_rate=5e-4, decay=False),
        Architecture("deep", (128, 64), "tanh", "linear", **_DECAYING),
        Architecture("linear", (), "linear", "linear", **_DECAYING),
    )
}


def get_architecture(name: str) -> Architecture:
    """The architecture of that name.

    One's own hidden sizes, as 64x64 or 64,64, give one that is like `deep` otherwise.
    """
    if not _SIZES.fullmatch(name):
        choices = {**ARCHITECTURES, "sizes such as 64x64": ARCHITECTURES["deep"]}
        return choose(name, ARCHITECTURES if name in ARCHITECTURES else choices, "architecture")
    hidden = tuple(map(int, re.split("[x,]", name)))
    if max(hidden) > MAX_UNITS:
        raise InputError(f"architecture {name} has {max(hidden)} units: the limit is {MAX_UNITS}")
    return replace(ARCHITECTURES["deep"], name="x".join(map(str, hidden)), hidden=hidden)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Within, torch's generator, which initialises weights, starts from a seed."""
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        yield


def stacks(
    architecture: Architecture, size: int, latent: int, seed: int, initial: str = "torch"
) -> tuple[nn.Sequential, nn.Sequential]:
    """Encoder and decoder, from `size` numbers to `latent` and back; untrained.

    The weights are torch's own, or, where `initial` is normal, of N(0, 1) with biases of 0.
    """
    sizes = (size, *architecture.hidden, latent)
    with seeded(seed):
        encoder = stack(sizes, architecture.code)
        decoder = stack(tuple(reversed(sizes)), architecture.output)
        if initial == "normal":
            for parameter in (*encoder.parameters(), *decoder.parameters()):
                (nn.init.normal_ if parameter.ndim > 1 else nn.init.zeros_)(parameter)
    return encoder, decoder


def stack(sizes: tuple[int, ...], last: str) -> nn.Sequential:
    """Dense layers of these widths, with ReLU between them and a last activation."""
    modules: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        modules += nn.Linear(inputs, outputs), nn.ReLU()
    return nn.Sequential(*modules[:-1], *([_MODULES[last]()] if last in _MODULES else []))


def layers(stack: nn.Sequential) -> tuple[Layer, ...]:
    """A stack's layers, as an encoder file holds them."""
    made = []
    for module, after in pairwise([*stack, None]):
        if isinstance(module, nn.Linear):
            weight, bias = (each.numpy(force=True).copy() for each in module.parameters())
            made.append(Layer(weight, bias, _NAMES.get(type(after), "linear")))
    return tuple(made)
