"""What a latent looks like: its units, and how many dimensions it fills."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.scaled import sample
from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.evaluate.evaluation import IntrinsicDimension, LatentUnits
from jbrep.evaluate.held_out import HeldOut, sample_rows
from jbrep.stats.bootstrap import without_nan

_ROWS = 200_000
_POINTS = 4_000  # for intrinsic dimensions
_SATURATED = 0.95  # magnitude of a tanh unit
_DEAD = 0.01  # standard deviation, as a share of the most variable unit's
_ROUNDING = 1e-6  # standard deviation that rounding alone can cause
_NEIGHBOURS = 20  # of the maximum-likelihood estimator


def latent_units(encoder: BaseEncoder, held_out: HeldOut) -> LatentUnits:
    """Units, their correlations, and dimensions of the latent, over a sample of held-out rows.

    At most 200,000 rows, fewer where the latent has more than 41 units; for the intrinsic dimension
    4,000. The participation ratio is (sum of the covariance's eigenvalues)^2 / sum of their
    squares.
    """
    rows = sample_rows(held_out.data.test, _ROWS, encoder.latent_size)
    values = encode(encoder, held_out, rows).astype(np.float64)
    deviation = values.std(axis=0)
    live = deviation > max(_DEAD * deviation.max(), _ROUNDING)
    return LatentUnits(
        mean=values.mean(axis=0).tolist(),
        variance=(deviation**2).tolist(),
        dead=tuple(np.flatnonzero(~live).tolist()),
        saturation=_saturation(encoder, values),
        correlation=_correlation(values, live),
        participation_ratio=_participation(values) if live.any() else None,
        intrinsic_dimension=intrinsic_dimension(sample(values, _POINTS)),
    )


def encode(encoder: BaseEncoder, held_out: HeldOut, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Latents of those rows, (n, l)."""
    return np.concatenate([encoder.encode(chunk) for chunk in held_out.data.observations(rows)])


def _participation(values: NDArray[np.float64]) -> float:
    spectrum = np.linalg.eigvalsh(np.atleast_2d(np.cov(values.T)))
    return float(spectrum.sum() ** 2 / np.square(spectrum).sum())


def _saturation(encoder: BaseEncoder, values: NDArray[np.float64]) -> tuple[float, ...] | None:
    """The share of rows in which each tanh unit is saturated; None for another latent."""
    layers = encoder.encoder if isinstance(encoder, Encoder) else ()
    if not layers or layers[-1].activation != "tanh":
        return None
    return tuple((np.abs(values) > _SATURATED).mean(axis=0).tolist())


def _correlation(values: NDArray[np.float64], live: NDArray[np.bool_]) -> Any:
    """Pearson's correlation of the units, (l, l); None for dead ones."""
    matrix = np.full((len(live), len(live)), np.nan)
    matrix[np.ix_(live, live)] = np.corrcoef(values[:, live].T)
    return without_nan(matrix.tolist())


def intrinsic_dimension(values: NDArray[Any]) -> IntrinsicDimension:
    """Estimates of how many dimensions points (n, k) fill locally, from scikit-dimension.

    TwoNN (Facco et al. 2017) and the maximum likelihood of Levina and Bickel (2005). None where
    there are too few distinct points.
    """
    from skdim.id import MLE, TwoNN  # not at the top: it takes seconds

    points = np.unique(values, axis=0)
    if len(points) <= 2 * _NEIGHBOURS:
        return IntrinsicDimension(two_nn=None, mle=None)
    points = np.pad(points, ((0, 0), (0, 1)))  # the library refuses a single column
    estimates = TwoNN().fit(points).dimension_, MLE(K=_NEIGHBOURS).fit(points).dimension_
    two_nn, mle = without_nan([float(estimate) for estimate in estimates])
    return IntrinsicDimension(two_nn=two_nn, mle=mle)
