"""Encoders in closed form, to compare learned ones with."""

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.encoders.encoder import Layer

Layers = tuple[Layer, ...]


def pca(data: ScaledDataset, latent: int) -> tuple[Layers, Layers]:
    """Principal components, the linear code of least squared error on the training part.

    The sign of each component makes its largest weight positive.
    """
    _, vectors = np.linalg.eigh(data.moments.covariance)
    components = vectors[:, ::-1][:, :latent].T
    largest = np.abs(components).argmax(axis=1, keepdims=True)
    components = components * np.sign(np.take_along_axis(components, largest, axis=1))
    return linear_code(components, data.moments)


def random_projection(data: ScaledDataset, latent: int, seed: int) -> tuple[Layers, Layers]:
    """Uniformly random orthonormal directions, with the best linear decoder for them."""
    drawn = np.random.default_rng(seed).normal(size=(data.task.size, latent))
    directions, triangle = np.linalg.qr(drawn)
    return linear_code((directions * np.sign(np.diag(triangle))).T, data.moments)


def linear_code(weight: NDArray[np.float64], moments: Moments) -> tuple[Layers, Layers]:
    """The encoder z = W (x - mean), with the linear decoder of least squared error.

    The decoder is C W' (W C W')^-1 z + mean, with the covariance C.
    """
    mean, covariance = moments
    back = covariance @ weight.T @ np.linalg.pinv(weight @ covariance @ weight.T)
    return (_linear(weight, -weight @ mean),), (_linear(back, mean),)


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
    return (_linear(weight, -weight @ mean),), (_linear(directions, mean),)


def _linear(weight: NDArray[np.float64], bias: NDArray[np.float64]) -> Layer:
    return Layer(np.ascontiguousarray(weight, dtype=np.float32), bias.astype(np.float32), "linear")
