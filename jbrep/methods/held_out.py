"""How well encoders reconstruct held-out rows, and how they compare with PCA."""

from collections.abc import Container

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.header import EncoderHeader
from jbrep.methods.linear import principal_code

NOTHING = 1e-10  # mean squared error of features scaled to [-1, 1]: rounding


def held_out_error(
    encoder: Encoder, data: ScaledDataset, not_decoded: Container[str] = ()
) -> float:
    """Mean squared error of the reconstruction over all held-out rows, scaled to [-1, 1].

    Features that are `not_decoded` count as 0. Rounded to six digits: the others depend on the
    number of threads.
    """
    decoded = [name not in not_decoded for name in data.task.feature_names]
    total = 0.0
    for rows in data.observations(data.test):
        error = lost(encoder, rows, data)[:, decoded]
        total += float(np.square(error, dtype=np.float64).sum())
    return float(f"{total / (len(data.test) * data.task.size):.6g}")


def lost(
    encoder: BaseEncoder, rows: NDArray[np.float32], data: ScaledDataset
) -> NDArray[np.float32]:
    """What a reconstruction of rows (n, d) lacks, in half widths of the features in the data.

    An encoder on coordinates is judged by what these tell of the rows: angles round the circle,
    quaternions of either sign, and a robot that symmetry puts at the origin as it stands there.

    Args:
        encoder: that can decode.
        rows: in physical units.
        data: whose scaling counts.
    """
    back = encoder.decode(encoder.encode(rows))
    if isinstance(encoder, Encoder) and (coordinates := encoder.scaler.coordinates):
        rows = coordinates.inverse(coordinates.forward(rows))
    return (encoder.comparable(back, rows) - rows) / data.scaler.half_width


def ratio_to_pca(encoder: Encoder, data: ScaledDataset) -> float | None:
    """An encoder's held-out error as a multiple of PCA's, with as many components.

    Both are of what the encoder tells at all: symmetry leaves out where the robot is. None where
    PCA loses nothing.
    """
    if encoder.latent_size >= data.task.size:
        return None
    layers = principal_code(data, encoder.latent_size)
    header = EncoderHeader(kind="pca", name="pca", environment=data.task)
    pca = Encoder(header, data.scaler, *layers)
    ours, theirs = (held_out_error(each, data, encoder.not_decoded) for each in (encoder, pca))
    return ours / theirs if theirs > NOTHING else None
