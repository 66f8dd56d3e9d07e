"""Linear codes: principal components, and what every method that finds directions needs.

Principal components are also what other encoders' reconstructions are compared with.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.layers import dense
from jbrep.envs.task import Array
from jbrep.errors import InputError
from jbrep.training.method import ClosedForm, Coded, Made
from jbrep.training.objective import Layers

DEVIATION = 1 / 3  # of a unit of a scaled code, so that most of its values lie in [-1, 1]
NOTHING = 1e-10  # mean squared error of features scaled to [-1, 1]: rounding
NEGLIGIBLE = 1e-9  # variance, as a share of the largest
_TINY = 1e-300  # variance of what is constant, to divide by
_NAMED = 0.1  # part in a linear dependence from which a feature is named, beside the largest


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


def signed(weight: Array) -> Array:
    """Rows (l, d) with signs that make the largest weight of each positive."""
    largest = np.abs(weight).argmax(axis=1, keepdims=True)
    return weight * np.sign(np.take_along_axis(weight, largest, axis=1))


def direction_code(directions: Array, moments: Moments, spectrum: Array) -> Made:
    """The linear code of directions (l, d) of any length, each unit with standard deviation 1/3.

    `spectrum` is what the method says of all directions, the largest first.
    """
    mean, covariance = moments
    variances = np.einsum("li,ij,lj->l", directions, covariance, directions)
    weight = DEVIATION * signed(directions / np.sqrt(variances)[:, None])
    return Made((dense(weight, -weight @ mean),), None, {"spectrum": spectrum.tolist()})


def whitening(
    covariance: Array, data: ScaledDataset, total: Array | None = None, others: str = "each other"
) -> Array:
    """W with W C W' = I, for a covariance C of the features (size, size).

    `total` are the variances that show what is negligible, where C is what a regression on `others`
    left of them.
    """
    deviation = np.sqrt(np.maximum(np.diag(covariance) if total is None else total, _TINY))
    variances, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    if not variances[0] > NEGLIGIBLE * variances[-1]:
        share = np.abs(vectors[:, 0])
        named = [data.names[i] for i in np.flatnonzero(share > _NAMED * share.max())]
        raise InputError(
            f"the covariance of {', '.join(dict.fromkeys(named))} in {data.dataset.folder} is "
            f"singular, as of linear functions of {others}: let one of them pass around the "
            "encoder, with `keep`"
        )
    whiten: Array = (vectors / np.sqrt(variances)).T / deviation
    return whiten


class PCA(Coded, ClosedForm, frozen=True, kw_only=True):
    """The first l principal components: the linear encoder of least error."""

    name: ClassVar[str] = "pca"
    min_reduction: ClassVar[int | None] = 0

    def make(self, data: ScaledDataset) -> Made:
        return Made(*principal_code(data, self.latent))


class Directions(Coded, ClosedForm, frozen=True, kw_only=True):
    """A method whose units are directions: of features that vary, at most as many as those."""

    min_reduction: ClassVar[int | None] = 0

    def check_data(self, data: ScaledDataset) -> None:
        if constant := data.constant_features:
            raise InputError(
                f"{constant[0]} is constant in {data.dataset.folder}: let it pass around the "
                f"encoder, with `keep` {constant[0]}"
            )
        super().check_data(data)


def held_out_error(encoder: Encoder, data: ScaledDataset) -> float:
    """Mean squared error of the reconstruction over all held-out rows, scaled to [-1, 1].

    Rounded to six digits: the others depend on the number of threads.
    """
    total = 0.0
    for rows in data.observations(data.test):
        total += float(np.square(lost(encoder, rows, data), dtype=np.float64).sum())
    return float(f"{total / (len(data.test) * data.task.size):.6g}")


def lost(
    encoder: BaseEncoder, rows: NDArray[np.float32], data: ScaledDataset
) -> NDArray[np.float32]:
    """What a reconstruction of rows (n, d) lacks, in half widths of the features in the data.

    An encoder on coordinates is judged by what these tell of the rows: angles round the circle,
    quaternions of either sign, and a robot that symmetry puts at the origin as it stands there.
    """
    back = encoder.decode(encoder.encode(rows))
    if isinstance(encoder, Encoder) and (coordinates := encoder.scaler.coordinates):
        rows = coordinates.inverse(coordinates.forward(rows))
    return (encoder.comparable(back, rows) - rows) / data.scaler.half_width
