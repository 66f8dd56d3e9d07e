"""What an encoder and its decoder lose of held-out rows."""

from collections.abc import Sequence

import numpy as np

from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.header import EncoderHeader
from jbrep.evaluate.evaluation import FeatureError, Reconstruction, Score, score, scores
from jbrep.evaluate.held_out import HeldOut
from jbrep.evaluate.registry import Judged, Scalar, diagnostic
from jbrep.methods.held_out import NOTHING, lost
from jbrep.methods.linear import principal_code
from jbrep.stats.bootstrap import Array, bootstrap, r_squared, variation


def reconstruction(encoder: BaseEncoder, held_out: HeldOut) -> Reconstruction:
    """Errors over all held-out rows, of features scaled to [-1, 1] and in physical units.

    They come with the error of PCA with as many components, fitted on the training part, and with
    the ratio of both over what the encoder tells at all: symmetry leaves out where the robot is.
    """
    ours, pca = _losses(encoder, held_out), held_out.once(_pca, encoder.latent_size)
    decoded = [name not in encoder.not_decoded for name in held_out.data.task.feature_names]
    over_decoded = _means(ours[:, decoded]), _means(pca[:, decoded])
    loses = over_decoded[1].sum() > NOTHING * held_out.row_counts.sum()
    is_smaller = encoder.latent_size < held_out.data.task.size
    return Reconstruction(
        mse=score(bootstrap(_mean, _means(ours), held_out.row_counts)),
        pca_mse=score(bootstrap(_mean, _means(pca), held_out.row_counts)),
        ratio_to_pca=score(bootstrap(_mean, *over_decoded)) if is_smaller and loses else None,
        features=_by_feature(ours, held_out, encoder.not_decoded),
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
    """Sums over each group of the means over features, (groups, 1), from those of each."""
    return sums.mean(axis=1, keepdims=True)


def _mean(total: Array, rows: Array) -> Array:
    """Mean over rows, from the sums (..., 1) of a value of each row."""
    return (total / rows)[..., 0]


def _losses(encoder: BaseEncoder, held_out: HeldOut) -> Array:
    """Sums of each scaled feature's squared errors over each group of episodes, (groups, d)."""
    data = held_out.data
    errors = (lost(encoder, rows, data) for rows in data.observations(data.test))
    (sums,) = held_out.sums_of_parts(data.test, ([np.square(each)] for each in errors))
    return sums


def _pca(held_out: HeldOut, latent: int) -> Array:
    """The same of PCA."""
    data = held_out.data
    header = EncoderHeader(kind="pca", name="pca", environment=data.task)
    return _losses(Encoder(header, data.scaler, *principal_code(data, latent)), held_out)


def _by_feature(
    sums: Array, held_out: HeldOut, not_decoded: Sequence[str]
) -> tuple[FeatureError, ...]:
    """The error of each feature; no R^2 of those that an encoder leaves out."""
    data, rows = held_out.data, held_out.row_counts
    total, squares = held_out.variation
    width = data.scaler.half_width.astype(float)
    mse = scores(bootstrap(lambda e, n: e / n, sums, rows))
    rmse = scores(bootstrap(lambda e, n: np.sqrt(e / n) * width, sums, rows))
    r2 = scores(
        bootstrap(lambda e, t, s, n: r_squared(e, variation(t, s, n)), sums, total, squares, rows)
    )
    r2 = [
        Score(None) if f.name in not_decoded else each
        for f, each in zip(data.task.features, r2, strict=True)
    ]
    return tuple(
        FeatureError(name=f.name, unit=f.unit, mse=mse[i], rmse_physical=rmse[i], r2=r2[i])
        for i, f in enumerate(data.task.features)
    )
