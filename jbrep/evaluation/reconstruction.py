"""What an encoder and its decoder lose of held-out rows."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.header import EncoderHeader
from jbrep.evaluation.evaluation import (
    FeatureError,
    Judged,
    Reconstruction,
    Scalar,
    Score,
    diagnostic,
    score,
    scores,
)
from jbrep.evaluation.held_out import HeldOut
from jbrep.methods.linear import NOTHING, lost, principal_code
from jbrep.stats.bootstrap import Array, bootstrap, r_squared, variation


def reconstruction(encoder: BaseEncoder, held_out: HeldOut) -> Reconstruction:
    """Errors over all held-out rows, of features scaled to [-1, 1] and in physical units.

    They come with the error of PCA with as many components, fitted on the training part, and with
    the ratio of both over what the encoder tells at all: symmetry leaves out where the robot is.
    """
    task = held_out.data.task
    ours, pca = _losses(encoder, held_out), held_out.once(_pca, encoder.latent_size)
    decoded = [name not in encoder.not_decoded for name in task.feature_names]
    over_decoded = _means(ours.errors[:, decoded]), _means(pca.errors[:, decoded])
    loses = over_decoded[1].sum() > NOTHING * ours.rows.sum()
    is_smaller = encoder.latent_size < task.size
    return Reconstruction(
        mse=score(bootstrap(_mean, _means(ours.errors), ours.rows)),
        pca_mse=score(bootstrap(_mean, _means(pca.errors), ours.rows)),
        ratio_to_pca=score(bootstrap(_mean, *over_decoded)) if is_smaller and loses else None,
        features=_by_feature(ours, held_out, decoded),
    )


@diagnostic(
    Scalar("error", "squared error of the reconstruction", better=-1),
    Scalar("times_pca", "that error over PCA's", better=-1),
)
def errors(e: Judged) -> tuple[Score | None, Score | None]:
    """As `reconstruction` has them; None of an encoder that doesn't decode."""
    found = e.known.reconstruction
    return (found.mse, found.ratio_to_pca) if found else (None, None)


def _means(sums: Array) -> Array:
    return sums.mean(axis=1, keepdims=True)


def _mean(total: Array, rows: Array) -> Array:
    return (total / rows)[..., 0]


class _Losses(NamedTuple):
    """Sums over the rows of each group of episodes."""

    errors: Array  # of each scaled feature's squared errors, (groups, d)
    total: Array  # of the scaled features, (groups, d)
    squares: Array  # of their squares, (groups, d)
    rows: Array  # their number, (groups, 1)


def _losses(encoder: BaseEncoder, held_out: HeldOut) -> _Losses:
    data = held_out.data

    def parts() -> Iterator[list[NDArray[np.floating]]]:
        for rows in data.observations(data.test):
            scaled = data.scale(rows).astype(np.float64)
            errors = np.square(lost(encoder, rows, data))
            yield [errors, scaled, scaled**2, np.ones((len(rows), 1))]

    return _Losses(*held_out.sums_of_parts(data.test, parts()))


def _pca(held_out: HeldOut, latent: int) -> _Losses:
    data = held_out.data
    header = EncoderHeader(kind="pca", name="pca", environment=data.task)
    return _losses(Encoder(header, data.scaler, *principal_code(data, latent)), held_out)


def _by_feature(
    ours: _Losses, held_out: HeldOut, decoded: Sequence[bool]
) -> tuple[FeatureError, ...]:
    """The error of each feature; no R^2 of those that an encoder leaves out."""
    width = held_out.data.scaler.half_width.astype(float)
    errors, total, squares, rows = ours
    mse = scores(bootstrap(lambda e, n: e / n, errors, rows))
    rmse = scores(bootstrap(lambda e, n: np.sqrt(e / n) * width, errors, rows))
    r2 = scores(
        bootstrap(lambda e, t, s, n: r_squared(e, variation(t, s, n)), errors, total, squares, rows)
    )
    return tuple(
        FeatureError(
            name=feature.name,
            unit=feature.unit,
            mse=mse[i],
            rmse_physical=rmse[i],
            r2=r2[i] if decoded[i] else Score(None),
        )
        for i, feature in enumerate(held_out.data.task.features)
    )
