"""The autoencoder's network."""

import re
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor, nn

from jbrep.encoders import Layer
from jbrep.encoders.encoder import MAX_UNITS
from jbrep.errors import InputError, choose
from jbrep.files.container import MAX_BYTES

_MODULES = {"relu": nn.ReLU, "tanh": nn.Tanh}
_SIZES = re.compile(r"[1-9][0-9]{0,8}([x,][1-9][0-9]{0,8})*")
_BYTES = 4  # of a number in float32
_NAMES = {module: name for name, module in _MODULES.items()}


@dataclass(frozen=True)
class Architecture:
    """The layers between observation and latent, and the default settings of training."""

    name: str  # paper, deep, or the hidden sizes, as 64x64
    hidden: tuple[int, ...]  # widths from observation to latent, mirrored in the decoder; ReLU
    output: str  # activation of the reconstruction; the latent's is tanh
    epochs: int
    learning_rate: float
    decay: bool  # whether the learning rate falls to zero along a cosine


ARCHITECTURES = {
    each.name: each
    for each in (
        Architecture("paper", (), "tanh", epochs=200, learning_rate=5e-4, decay=False),
        Architecture("deep", (128, 64), "linear", epochs=12, learning_rate=2e-3, decay=True),
    )
}


def get_architecture(name: str) -> Architecture:
    """The architecture of that name.

    One's own hidden sizes, as 64x64 or 64,64, give one that is like `deep` otherwise.

    Raises:
        InputError: the name is unknown; the message lists the architectures. Or a size is out of
            range.
    """
    if not _SIZES.fullmatch(name):
        choices = {**ARCHITECTURES, "sizes such as 64x64": ARCHITECTURES["deep"]}
        return choose(name, ARCHITECTURES if name in ARCHITECTURES else choices, "architecture")
    hidden = tuple(map(int, re.split("[x,]", name)))
    if max(hidden) > MAX_UNITS:
        raise InputError(f"architecture {name} has {max(hidden)} units: the limit is {MAX_UNITS}")
    return replace(ARCHITECTURES["deep"], name="x".join(map(str, hidden)), hidden=hidden)


def check_size(architecture: Architecture, size: int, latent: int) -> None:
    """Make sure that a network from `size` features to `latent` units fits an encoder's file.

    Raises:
        InputError: it is too large.
    """
    widths = (size, *architecture.hidden, latent)
    needed = 2 * _BYTES * sum(before * after for before, after in pairwise(widths))
    if needed > MAX_BYTES:
        raise InputError(
            f"architecture {architecture.name} has weights of {needed:,} bytes with {size} "
            f"features: an encoder's file has at most {MAX_BYTES:,}; choose smaller sizes"
        )


class Autoencoder(nn.Module):
    """Encoder and decoder, from d features to l and back; untrained."""

    def __init__(self, architecture: Architecture, size: int, latent: int, seed: int):
        super().__init__()
        sizes = (size, *architecture.hidden, latent)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            self.encoder = _stack(sizes, "tanh")
            self.decoder = _stack(tuple(reversed(sizes)), architecture.output)

    def forward(self, values: Tensor) -> Tensor:
        """Reconstructions of scaled observations (n, d)."""
        return self.decoder(self.encoder(values))


def _stack(sizes: tuple[int, ...], last: str) -> nn.Sequential:
    modules: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        modules += nn.Linear(inputs, outputs), nn.ReLU()
    return nn.Sequential(*modules[:-1], *([_MODULES[last]()] if last in _MODULES else []))


def layers(stack: nn.Sequential) -> tuple[Layer, ...]:
    """A stack's layers, as an encoder file holds them."""
    made = []
    modules = [*stack, None]
    for module, after in pairwise(modules):
        if isinstance(module, nn.Linear):
            weight, bias = (p.detach().cpu().numpy().copy() for p in module.parameters())
            made.append(Layer(weight, bias, _NAMES.get(type(after), "linear")))
    return tuple(made)
