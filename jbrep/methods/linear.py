"""Linear codes: their layers, and the linear maps of least error between two sets of numbers."""

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.encoders.encoder import Layer
from jbrep.errors import InputError
from jbrep.methods.method import Layers, Settings

Array = NDArray[np.float64]

DEVIATION = 1 / 3  # of a unit of a scaled code, so that most of its values lie in [-1, 1]
_NEGLIGIBLE = 1e-9  # variance, as a share of the largest


def principal_code(data: ScaledDataset, latent: int) -> tuple[Layers, Layers]:
    """Principal components, the linear code of least squared error on the training part.

    The sign of each component makes its largest weight positive.
    """
    _, vectors = np.linalg.eigh(data.moments.covariance)
    return linear_code(signed(vectors[:, ::-1][:, :latent].T), data.moments)


def linear_code(weight: Array, moments: Moments) -> tuple[Layers, Layers]:
    """The encoder z = W (x - mean), with the linear decoder of least squared error.

    The decoder is C W' (W C W')^-1 z + mean, with the covariance C.
    """
    mean, covariance = moments
    back = covariance @ weight.T @ np.linalg.pinv(weight @ covariance @ weight.T)
    return (dense(weight, -weight @ mean),), (dense(back, mean),)


def linear_denoiser(latent: int, noise: float, moments: Moments) -> tuple[Layers, Layers]:
    """The linear code of that size with the least error in restoring clean rows from corrupted.

    Corruption adds noise of standard deviation `noise` to each feature. The best denoiser of full
    rank is ridge regression, B = C (C + noise^2 I)^-1; of rank l, it is B projected on the first l
    principal directions of its output B C (reduced-rank regression, Izenman 1975).
    """
    mean, covariance = moments
    corrupted = covariance + noise**2 * np.eye(len(mean))
    ridge = covariance @ np.linalg.pinv(corrupted, hermitian=True)
    _, vectors = np.linalg.eigh(ridge @ covariance)
    directions = vectors[:, ::-1][:, :latent]
    weight = directions.T @ ridge
    return (dense(weight, -weight @ mean),), (dense(directions, mean),)


def dense(weight: Array, bias: Array, activation: str = "linear") -> Layer:
    """A layer from float64."""
    single = np.ascontiguousarray(weight, dtype=np.float32)
    return Layer(single, bias.astype(np.float32), activation)


def signed(weight: Array) -> Array:
    """Rows (l, d) with signs that make the largest weight of each positive."""
    largest = np.abs(weight).argmax(axis=1, keepdims=True)
    return weight * np.sign(np.take_along_axis(weight, largest, axis=1))


def inverse_root(covariance: Array, what: str) -> Array:
    """C^(-1/2) of a covariance (n, n).

    Raises:
        InputError: it is singular; the message says what it is the covariance of.
    """
    variances, vectors = np.linalg.eigh(covariance)
    if not variances[0] > _NEGLIGIBLE * variances[-1]:
        raise InputError(
            f"the covariance of {what} is singular: some are constant or depend on others linearly"
        )
    return (vectors / np.sqrt(variances)) @ vectors.T


def check_varying(data: ScaledDataset, settings: Settings) -> None:
    """Make sure that no feature is constant, where a method needs all to vary.

    Raises:
        InputError: one is.
    """
    if constant := [name for name in data.constant_features if name in data.names]:
        raise InputError(
            f"{constant[0]} is constant in {data.dataset.folder}: it can't be part of such a code"
        )
