"""What a network learns."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import torch
from torch import Tensor, nn

from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import Layer
from jbrep.errors import InputError
from jbrep.training.network import layers
from jbrep.training.windows import Windows

Layers = tuple[Layer, ...]


class Objective(nn.Module, ABC):
    """A network with its loss, and how an encoder is taken from it.

    Attributes:
        encoder: gives the code.
        horizon: steps that a window reaches ahead.
        kept_by: the loss of which the epoch with the least is kept, so that held-out rows have no
            influence if it is that of training; None keeps the last one, as where the target of the
            loss learns as well, so that losses of different epochs can't be compared.
    """

    encoder: nn.Sequential
    horizon: int = 0
    kept_by: Literal["train_loss", "test_loss"] | None = "train_loss"

    def prepare(self, windows: Windows) -> None:
        """Fit what is constant in training, such as scales of targets, to training windows."""

    def batch(self, windows: Windows, numbers: Tensor) -> Any:
        """What the loss is of: those windows, as a tuple of tensors (n, ...)."""
        return windows.steps(numbers)

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[Any]:
        """Batches of at most `size` windows, in order; runs beside the training, a little ahead.

        Noise is drawn from the generator.
        """
        parts = (part.split(size) for part in self.batch(windows, numbers))
        yield from zip(*parts, strict=True)

    @abstractmethod
    def loss(self, batch: Any) -> Tensor:
        """The mean loss of a batch, differentiable; in evaluation without noise."""

    def gradient(self, batch: Any) -> Tensor:
        """Set every parameter's gradient, and return the mean loss."""
        for parameter in self.parameters():
            parameter.grad = None
        loss = self.loss(batch)
        loss.backward()
        return loss.detach()

    def rate(self, progress: float, step: int) -> float:
        """What the learning rate is multiplied by: by default falling to 0 along a cosine.

        `progress` is the share of the training that is done, `step` counts gradient steps.
        """
        return (1 + math.cos(math.pi * progress)) / 2

    def layers(self) -> tuple[Layers, Layers | None]:
        """The layers of encoder and decoder; None where no decoder is learned."""
        return layers(self.encoder), None

    def report(self, windows: Windows) -> dict[str, Any]:
        """What it says of itself on some held-out windows, as plain JSON for the file's header."""
        return {}


def feature_weights(data: ScaledDataset, weights: Mapping[str, float]) -> Tensor | None:
    """A weight for each number of a scaled row, (size,); None where all are 1."""
    values = torch.ones(data.scaler.size)
    found = {name: data.scaler.places((name,), data.task) for name in weights}
    for name in sorted(found, key=lambda name: (-len(found[name]), name)):  # one over a pattern
        places, weight = found[name], weights[name]
        if not set(places) & set(data.used):
            raise InputError(f"{name} passes around the encoder unchanged: it can't have a weight")
        values[places] = float(weight)
    values = values[torch.from_numpy(data.used)]
    if not values.any():
        raise InputError("all weights of features are 0: give at least one above 0")
    return values if weights else None
