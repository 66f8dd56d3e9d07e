"""What an encoder and its decoder lose, from clean and from corrupted observations."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.header import EncoderHeader
from jbrep.evaluate.evaluation import (
    Corruption,
    EpisodeError,
    FeatureError,
    Reconstruction,
    Score,
    score,
    scores,
)
from jbrep.evaluate.held_out import HeldOut, Rows
from jbrep.methods.held_out import NOTHING, lost
from jbrep.methods.linear import linear_denoiser, principal_code
from jbrep.stats.bootstrap import Array, bootstrap, by_episode, r_squared, variation
from jbrep.training.objective import Layers

NOISES = (0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)  # of features scaled to [-1, 1]
_QUANTILES = (0.5, 0.9, 0.99, 0.999, 1)
_CORRUPTED_ROWS = 100_000
_WORST = 5
_NONE = Score(None, None, None)


class _Losses(NamedTuple):
    """Squared errors of scaled features."""

    sums: Array  # of each feature over each group of episodes, (groups, d)
    by_row: NDArray[np.float32]  # means over the features of each row, (n,)


def reconstruction(encoder: BaseEncoder, held_out: HeldOut) -> Reconstruction:
    """Errors over all held-out rows, of features scaled to [-1, 1] and in physical units.

    They come with the error of PCA with as many components, fitted on the training part, and with
    the ratio of both over what the encoder tells at all: symmetry leaves out where the robot is.
    """
    losses = _losses(encoder, held_out, held_out.data.test)
    quantiles = np.quantile(losses.by_row, _QUANTILES).tolist()
    ours, pca = losses.sums, held_out.once(_pca, encoder.latent_size)
    decoded = _decoded(encoder, held_out)
    over_decoded = _means(ours[:, decoded]), _means(pca[:, decoded])
    loses = over_decoded[1].sum() > NOTHING * held_out.row_counts.sum()
    is_smaller = encoder.latent_size < held_out.data.task.size
    return Reconstruction(
        mse=score(bootstrap(_mean, _means(ours), held_out.row_counts)),
        pca_mse=score(bootstrap(_mean, _means(pca), held_out.row_counts)),
        ratio_to_pca=score(bootstrap(_mean, *over_decoded)) if is_smaller and loses else None,
        features=_by_feature(ours, held_out, encoder.not_decoded),
        quantiles=dict(zip(map(str, _QUANTILES), quantiles, strict=True)),
        worst_episodes=_worst(losses.by_row, held_out),
    )


def corruption(encoder: BaseEncoder, held_out: HeldOut) -> tuple[Corruption, ...]:
    """Errors of reconstructing clean rows from corrupted ones, at each noise level.

    They come with the error of the corrupted rows themselves, and with that of the best linear
    denoiser of the same latent size at that level. All are of a sample of at most 100,000 rows, and
    over the features that the encoder tells at all.
    """
    decoded = _decoded(encoder, held_out)
    rows = sample(held_out.data.test, _CORRUPTED_ROWS)
    (counts,) = held_out.sums(rows, np.ones((len(rows), 1)))
    levels = []
    for noise in NOISES:
        ours = _means(_losses(encoder, held_out, rows, noise).sums[:, decoded])
        best = _means(held_out.once(_best_linear, encoder.latent_size, noise)[:, decoded])
        levels.append(
            Corruption(
                noise=noise,
                mse=score(bootstrap(_mean, ours, counts)),
                input_mse=noise**2,
                linear_mse=score(bootstrap(_mean, best, counts)),
            )
        )
    return tuple(levels)


def _decoded(encoder: BaseEncoder, held_out: HeldOut) -> list[bool]:
    """Which features the encoder tells at all."""
    return [name not in encoder.not_decoded for name in held_out.data.task.feature_names]


def _means(sums: Array) -> Array:
    """Sums over each group of the means over features, (groups, 1), from those of each."""
    return sums.mean(axis=1, keepdims=True)


def _mean(total: Array, rows: Array) -> Array:
    """Mean over rows, from the sums (..., 1) of a value of each row."""
    return (total / rows)[..., 0]


def _losses(encoder: BaseEncoder, held_out: HeldOut, rows: Rows, noise: float = 0) -> _Losses:
    """What is lost of those rows, corrupted by the same noise for every encoder."""
    by_row: list[NDArray[np.float32]] = []

    def parts() -> Iterator[list[NDArray[np.float32]]]:
        for errors in _errors(encoder, held_out.data, rows, noise):
            by_row.append(errors.mean(axis=1))
            yield [errors]

    (sums,) = held_out.sums_of_parts(rows, parts())
    return _Losses(sums, np.concatenate(by_row))


def _errors(
    encoder: BaseEncoder, data: ScaledDataset, rows: Rows, noise: float
) -> Iterator[NDArray[np.float32]]:
    """Squared errors of each scaled feature, (n, d), some rows at a time."""
    width = data.scaler.half_width
    random = np.random.default_rng(0)
    for observation in data.observations(rows):
        drawn = random.standard_normal(observation.shape, np.float32) if noise else 0
        yield np.square(lost(encoder, observation, data, observation + noise * drawn * width))


def _best_linear(held_out: HeldOut, latent: int, noise: float) -> Array:
    """The sums over each group of the best linear denoiser's errors, of each feature."""
    data = held_out.data
    linear = _linear(data, linear_denoiser(latent, noise, data.moments))
    return _losses(linear, held_out, sample(data.test, _CORRUPTED_ROWS), noise).sums


def _pca(held_out: HeldOut, latent: int) -> Array:
    """The sums over each group of PCA's errors, of each feature, (groups, d)."""
    data = held_out.data
    return _losses(_linear(data, principal_code(data, latent)), held_out, data.test).sums


def _linear(data: ScaledDataset, layers: tuple[Layers, Layers]) -> Encoder:
    header = EncoderHeader(kind="linear", name="linear", environment=data.task)
    return Encoder(header, data.scaler, *layers)


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
        _NONE if f.name in not_decoded else each
        for f, each in zip(data.task.features, r2, strict=True)
    ]
    return tuple(
        FeatureError(name=f.name, unit=f.unit, mse=mse[i], rmse_physical=rmse[i], r2=r2[i])
        for i, f in enumerate(data.task.features)
    )


def _worst(by_row: NDArray[np.float32], held_out: HeldOut) -> tuple[EpisodeError, ...]:
    """The episodes with the largest mean errors."""
    place = held_out.place(held_out.data.test)
    both = np.stack((by_row, np.ones_like(by_row)), axis=1)
    total, rows = by_episode(both, place, len(held_out)).T
    errors = total / rows
    order = np.argsort(-errors, kind="stable")[:_WORST]
    seeds = held_out.data.dataset.episodes["seed"]
    return tuple(
        EpisodeError(episode=number, seed=seeds[number], mse=mse)
        for number, mse in zip(held_out.numbers[order], errors[order], strict=True)
    )
