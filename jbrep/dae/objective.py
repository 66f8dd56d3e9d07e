"""What an autoencoder learns: to reconstruct a row, from a corrupted one if there is noise."""

from collections.abc import Iterator

import torch
from torch import Tensor

from jbrep.dae.gradient import Gradient
from jbrep.dae.network import Architecture, layers, stacks
from jbrep.training.objective import Layers, Objective
from jbrep.training.windows import Windows


class Reconstruction(Objective):
    """The mean squared error of a reconstruction.

    Batches are (features, rows), corrupted and clean.

    Args:
        architecture: of encoder and decoder.
        size: scaled numbers d in a row.
        latent: units l of the code.
        seed: of the initial weights.
        initial: `torch` for its initial weights, `normal` for N(0, 1) with biases of 0.
        noise: standard deviation of the corruption.
        shared_noise: whether one vector of noise corrupts all rows of a batch.
        weights: of each scaled number in the error, (d,); None for 1.
    """

    _weights: Tensor | None

    def __init__(
        self,
        architecture: Architecture,
        size: int,
        latent: int,
        seed: int,
        initial: str = "torch",
        noise: float = 0,
        shared_noise: bool = False,
        weights: Tensor | None = None,
    ):
        super().__init__()
        self.encoder, self.decoder = stacks(architecture, size, latent, seed, initial)
        self._decays = architecture.decay
        self._noise, self._shared = noise, shared_noise
        self.register_buffer("_weights", weights, persistent=False)
        self._gradient: Gradient | None = None

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Clean rows, twice."""
        clean = windows.rows(numbers).T.contiguous()
        return clean, clean

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Corrupted and clean rows."""
        clean = windows.rows(numbers).T.contiguous()
        for part in clean.split(size, 1) if self._shared else (clean,):
            corrupted = self._corrupt(part, generator)
            yield from zip(corrupted.split(size, 1), part.split(size, 1), strict=True)

    def _corrupt(self, clean: Tensor, generator: torch.Generator) -> Tensor:
        if not self._noise:
            return clean
        like = clean[:, :1] if self._shared else clean
        drawn = torch.empty_like(like).normal_(0, self._noise, generator=generator)
        return clean + drawn if self._shared else drawn.add_(clean)

    def loss(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        """As for `Objective`."""
        corrupted, clean = batch
        squares = (self.decoder(self.encoder(corrupted.T)) - clean.T).square()
        return (squares if self._weights is None else squares * self._weights).mean()

    def gradient(self, batch: tuple[Tensor, Tensor]) -> Tensor:
        """As for `Objective`, written out."""
        corrupted, clean = batch
        rows = corrupted.shape[1]
        if self._gradient is None or self._gradient.rows < rows:
            modules = (*self.encoder, *self.decoder)
            self._gradient = Gradient(modules, rows, self._weights)
        return self._gradient(corrupted, clean)

    def rate(self, progress: float, step: int) -> float:
        """As for `Objective`; the paper's doesn't fall."""
        return super().rate(progress, step) if self._decays else 1

    def layers(self) -> tuple[Layers, Layers]:
        """As for `Objective`."""
        return layers(self.encoder), layers(self.decoder)
