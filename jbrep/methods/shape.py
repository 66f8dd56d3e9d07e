"""What every code can have besides its method: a linear decoder, a scale, features around it."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.encoders.layers import Layer, run
from jbrep.methods.linear import DEVIATION, dense, inverse_root
from jbrep.methods.passes import Array
from jbrep.training.method import Made
from jbrep.training.objective import Layers

_NEGLIGIBLE = 1e-12  # variance of a unit that says nothing


class Complete(NamedTuple):
    """All of an encoder but its scaling and header."""

    layers: tuple[Layers, Layers]
    keep: tuple[str, ...]


def complete(
    made: Made, data: ScaledDataset, codes: str = "raw", keep: tuple[str, ...] = ()
) -> Complete:
    """What a method made, with the scale of its code, a decoder, and what passes around them.

    Args:
        made: by the method.
        data: scaled.
        codes: raw, standard or white.
        keep: features that pass around the layers, unless the method says which.

    Raises:
        InputError: the code can't be whitened.
    """
    encoder, decoder = made.encoder, made.decoder
    if not encoder:
        return Complete((encoder, ()), ())
    if codes != "raw" or decoder is None:
        moments, shared = _code_moments(encoder, data)
        if decoder is None:
            decoder = (_best_decoder(moments, shared, data),)
        if codes != "raw":
            encoder, decoder = _rescaled(encoder, decoder, moments, codes)
    return Complete((_widened(encoder, data, 1), _widened(decoder, data, 0)), made.keep or keep)


def _code_moments(layers: Layers, data: ScaledDataset) -> tuple[Moments, Array]:
    """Moments of the code over the training rows, and its covariance with the rows, (l, size)."""
    size = len(layers[-1].bias)
    total, products = np.zeros(size), np.zeros((size, size + data.size))
    for rows in data.chunks(data.train):
        code = run(layers, rows).astype(np.float64)
        total += code.sum(axis=0)
        products += code.T @ np.hstack((code, rows))
    count = len(data.train)
    mean = total / count
    covariance = products / count - np.outer(mean, np.concatenate((mean, data.moments.mean)))
    return Moments(mean, covariance[:, :size]), covariance[:, size:]


def _best_decoder(moments: Moments, shared: Array, data: ScaledDataset) -> Layer:
    """The linear map from the code to the row with the least squared error."""
    weight = shared.T @ np.linalg.pinv(moments.covariance, hermitian=True)
    return dense(weight, data.moments.mean - weight @ moments.mean)


def _rescaled(
    encoder: Layers, decoder: Layers, moments: Moments, codes: str
) -> tuple[Layers, Layers]:
    """The same code with standard deviation 1/3 in each unit, uncorrelated if it is to be white."""
    mean, covariance = moments
    if codes == "white":
        scale = DEVIATION * inverse_root(covariance, "the code")
    else:
        variance = np.diag(covariance)
        varies = variance > _NEGLIGIBLE
        scale = np.diag(np.where(varies, DEVIATION / np.sqrt(np.where(varies, variance, 1)), 1))
    return _after(encoder, scale, -scale @ mean), _before(decoder, np.linalg.inv(scale), mean)


def _after(layers: Layers, weight: Array, bias: Array) -> Layers:
    """Layers followed by an affine map."""
    last = layers[-1]
    if last.activation != "linear":
        return (*layers, dense(weight, bias))
    return (*layers[:-1], dense(weight @ last.weight, weight @ last.bias + bias))


def _before(layers: Layers, weight: NDArray[Any], bias: Array) -> Layers:
    """Layers after an affine map."""
    first = layers[0]
    both = dense(first.weight @ weight, first.weight @ bias + first.bias, first.activation)
    return (both, *layers[1:])


def _widened(layers: Layers, data: ScaledDataset, axis: int) -> Layers:
    """Layers that take (axis 1) or give (axis 0) all scaled numbers, not only those that are used.

    The others count nothing in the encoder, and come out as 0.
    """
    if data.size == data.scaler.size:
        return layers
    place = 0 if axis else -1
    weight, bias, activation = layers[place]
    full = list(layers)
    full[place] = Layer(
        _spread(weight, data.used, data.scaler.size, axis),
        bias if axis else _spread(bias, data.used, data.scaler.size, 0),
        activation,
    )
    return tuple(full)


def _spread(
    values: NDArray[np.float32], places: NDArray[np.int64], size: int, axis: int
) -> NDArray[np.float32]:
    """Values at their places along an axis of that size, zeros elsewhere."""
    shape = list(values.shape)
    shape[axis] = size
    wide = np.zeros(shape, np.float32)
    wide[(slice(None),) * axis + (places,)] = values
    return wide
