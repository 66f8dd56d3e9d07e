"""Reconstructions by a sigmoid, which are of rows brought from [-1, 1] to [0, 1]."""

import numpy as np
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from jbrep.encoders.layers import Layer
from jbrep.training.objective import Layers


def cross_entropy(logits: Tensor, rows: Tensor, weights: Tensor | None) -> Tensor:
    """The binary cross-entropy of each number, (n, d).

    Scaled values beyond [-1, 1], which held-out rows and scalings other than by extrema have, count
    as its ends: no sigmoid gives more, and beyond them the cross-entropy has no least value.

    Args:
        logits: of the reconstruction, (n, d).
        rows: scaled, (n, d).
        weights: of each number, (d,); None for 1.
    """
    target = ((rows + 1) / 2).clamp(0, 1)
    return binary_cross_entropy_with_logits(logits, target, weights, reduction="none")


def sigmoid_layers(layers: Layers) -> Layers:
    """Layers that give logits, followed by what makes them scaled numbers, 2 sigmoid - 1."""
    weight, bias, _ = layers[-1]
    size = len(bias)
    back = Layer(2 * np.eye(size, dtype=np.float32), -np.ones(size, np.float32), "linear")
    return (*layers[:-1], Layer(weight, bias, "sigmoid"), back)
