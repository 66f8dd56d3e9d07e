"""The autoencoder's network."""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from jbrep.encoders import Layer
from jbrep.errors import choose

_MODULES = {"relu": nn.ReLU, "tanh": nn.Tanh}
_NAMES = {module: name for name, module in _MODULES.items()}


@dataclass(frozen=True)
class Architecture:
    """The layers between observation and latent, and the default settings of training."""

    hidden: tuple[int, ...]  # widths from observation to latent, mirrored in the decoder; ReLU
    output: str  # activation of the reconstruction; the latent's is tanh
    epochs: int
    learning_rate: float
    decay: bool  # whether the learning rate falls to zero along a cosine


ARCHITECTURES = {
    "paper": Architecture((), "tanh", epochs=200, learning_rate=5e-4, decay=False),
    "deep": Architecture((128, 64), "linear", epochs=12, learning_rate=2e-3, decay=True),
}


def get_architecture(name: str) -> Architecture:
    """The architecture of that name.

    Raises:
        InputError: there is none; the message lists them.
    """
    return choose(name, ARCHITECTURES, "architecture")


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
