"""A chain of dense layers, collected one operation at a time."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.layers import EPSILON, LAYER_NORM, MAX_UNITS, Layer
from jbrep.errors import InputError

Array = NDArray[np.float64]


class Chain:
    """Layers from affine maps, of which any number in a row become one, and activations.

    Affine maps are multiplied in float64; the layers are float32.

    Args:
        size: numbers that the chain takes.

    Attributes:
        width: numbers that it gives so far.
    """

    def __init__(self, size: int):
        self.width = size
        self._layers: list[Layer] = []
        self._map: tuple[Array, Array] | None = None  # weight, bias after the last activation

    def affine(self, weight: Any, bias: Any = 0) -> None:
        """Add values @ weight.T + bias.

        Args:
            weight: (out, in).
            bias: (out,), or one number.

        Raises:
            InputError: other shapes.
        """
        weight, bias = np.asarray(weight, np.float64), np.asarray(bias, np.float64)
        if weight.ndim != 2 or not weight.size:
            raise InputError(f"its weight has shape {weight.shape}, expected (out, in)")
        outputs, inputs = weight.shape
        if inputs != self.width:
            raise InputError(f"it takes {inputs} numbers, but gets {self.width}")
        if outputs > MAX_UNITS:
            raise InputError(f"it has {outputs} units: the limit is {MAX_UNITS}")
        bias = _row(bias, outputs)
        if self._map:
            before, shift = self._map
            self._map = weight @ before, weight @ shift + bias
        else:
            self._map = weight, bias
        self.width = outputs

    def scale(self, factor: Any, shift: Any = 0) -> None:
        """Add values * factor + shift, each (width,) or one number.

        Raises:
            InputError: other shapes.
        """
        factor, shift = (_row(np.asarray(v, np.float64), self.width) for v in (factor, shift))
        weight, bias = self._map or (np.eye(self.width), np.zeros(self.width))
        self._map = weight * factor[:, None], bias * factor + shift

    def activate(self, name: str) -> None:
        """Add an activation, which ends a layer."""
        weight, bias = self._map or (np.eye(self.width), np.zeros(self.width))
        single = np.asarray(weight, np.float32, order="C"), np.float32(bias + 0.0)  # no -0.0
        self._layers.append(Layer(*single, name))
        self._map = None

    def layer_norm(self, epsilon: float) -> None:
        """Add a layer norm without weights of its own.

        With another epsilon than an encoder's it is the same one of values that are scaled: both
        then divide by the same number.

        Raises:
            InputError: an epsilon that is no positive number.
        """
        if not 0 < epsilon < math.inf:
            raise InputError(f"its epsilon is {epsilon}: it must be positive")
        if epsilon != EPSILON:
            self.scale(math.sqrt(EPSILON / epsilon))
        self.activate(LAYER_NORM)

    def layers(self) -> tuple[Layer, ...]:
        """All layers.

        Raises:
            InputError: there are none, since it leaves values as they are.
        """
        if self._map and not _is_nothing(*self._map):
            self.activate("linear")
        if not self._layers:
            raise InputError("it leaves what it takes as it is, so there is nothing to convert")
        return tuple(self._layers)


def _is_nothing(weight: Array, bias: Array) -> bool:
    """Whether an affine map leaves values as they are."""
    same = weight.shape[0] == weight.shape[1] and np.array_equal(weight, np.eye(len(weight)))
    return same and not bias.any()


def _row(values: Array, width: int) -> Array:
    """A row of so many numbers from one, or from a row.

    Raises:
        InputError: another shape.
    """
    if values.size == 1:
        return np.full(width, values.item())
    if values.shape not in ((width,), (1, width)):
        raise InputError(f"it has a constant of shape {values.shape}, expected ({width},)")
    return values.reshape(width)
