"""What every code can have besides its method: a linear decoder, a scale, features around it."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.encoders.layers import Layer, dense, run
from jbrep.envs.task import Array
from jbrep.methods.linear import DEVIATION, inverse_root
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

    `keep` names features that pass around the layers, unless the method says which.
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
    if data.size < data.scaler.size:
        encoder, decoder = _widened(encoder, decoder, data)
    every = data.scaler.features(data.task)
    kept = tuple(every[i].name for i in data.scaler.places(keep, data.task))
    return Complete((encoder, decoder), made.keep or kept)


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


def _widened(encoder: Layers, decoder: Layers, data: ScaledDataset) -> tuple[Layers, Layers]:
    """Layers that take and give all scaled numbers, not only those that are used.

    The others count nothing in the encoder, and come out as 0.
    """
    size, used = data.scaler.size, data.used
    first, last = encoder[0], decoder[-1]
    takes = np.zeros((len(first.bias), size), np.float32)
    takes[:, used] = first.weight
    gives, bias = np.zeros((size, last.weight.shape[1]), np.float32), np.zeros(size, np.float32)
    gives[used], bias[used] = last.weight, last.bias
    return (
        (first._replace(weight=takes), *encoder[1:]),
        (*decoder[:-1], last._replace(weight=gives, bias=bias)),
    )
