"""What an encoder and its decoder lose, from clean and from corrupted observations."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.encoders import Encoder
from jbrep.evaluate.held_out import HeldOut, Rows
from jbrep.methods.controls import Layers, linear_denoiser, pca
from jbrep.stats.bootstrap import Array, bootstrap, r_squared, variation

NOISES = (0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)  # of features scaled to [-1, 1]
_QUANTILES = (0.5, 0.9, 0.99, 0.999, 1)
_CORRUPTED_ROWS = 100_000
_WORST = 5


def reconstruction(encoder: Encoder, held_out: HeldOut) -> dict[str, Any]:
    """Errors over all held-out rows, of features scaled to [-1, 1] and in physical units.

    They come with the error of PCA with as many components, fitted on the training part.
    """
    data = held_out.data
    errors = _errors(encoder, data, data.test)
    (sums,) = held_out.sums(data.test, errors)
    return {
        "mse": bootstrap(_mean, sums, held_out.row_counts).tolist(),
        **_compared_with_pca(encoder.latent_size, sums, held_out),
        "features": _by_feature(sums, held_out),
        "quantiles": dict(
            zip(
                map(str, _QUANTILES),
                np.quantile(errors.mean(axis=1), _QUANTILES).tolist(),
                strict=True,
            )
        ),
        "worst_episodes": _worst(sums, held_out),
    }


def corruption(encoder: Encoder, held_out: HeldOut) -> list[dict[str, Any]]:
    """Errors of reconstructing clean rows from corrupted ones, at each noise level.

    They come with the error of the corrupted rows themselves, and with that of the best linear
    denoiser of the same latent size at that level.
    """
    data = held_out.data
    rows = sample(data.test, _CORRUPTED_ROWS)
    (counts,) = held_out.sums(rows, np.ones((len(rows), 1)))
    levels = []
    for noise in NOISES:
        (ours,) = held_out.sums(rows, _errors(encoder, data, rows, noise))
        best = _best_linear(held_out, encoder.latent_size, noise)
        levels.append(
            {
                "noise": noise,
                "mse": bootstrap(_mean, ours, counts).tolist(),
                "input_mse": noise**2,
                "linear_mse": bootstrap(_mean, best, counts).tolist(),
            }
        )
    return levels


def _mean(squares: Array, rows: Array) -> Array:
    """Mean over rows and features, from sums of squares (..., d)."""
    return squares.mean(axis=-1) / rows[..., 0]


def _errors(
    encoder: Encoder, data: ScaledDataset, rows: Rows, noise: float = 0
) -> NDArray[np.float32]:
    """Squared errors of each scaled feature, (n, d), with the same noise for every encoder."""
    width = data.scaler.half_width
    random = np.random.default_rng(0)
    errors = []
    for observation in data.observations(rows):
        drawn = random.standard_normal(observation.shape, np.float32) if noise else 0
        back = encoder.decode(encoder.encode(observation + noise * drawn * width))
        errors.append(np.square((back - observation) / width))
    return np.concatenate(errors)


@lru_cache(1024)  # since encoders of one size share it
def _best_linear(held_out: HeldOut, latent: int, noise: float) -> Array:
    """Sums of squared errors of the best linear denoiser, by episode."""
    data = held_out.data
    rows = sample(data.test, _CORRUPTED_ROWS)
    linear = _linear(data, linear_denoiser(latent, noise, data.moments))
    return held_out.sums(rows, _errors(linear, data, rows, noise))[0]


@lru_cache(1024)
def _pca(held_out: HeldOut, latent: int) -> Array:
    """Sums of squared errors of PCA, by episode."""
    data = held_out.data
    linear = _linear(data, pca(data, latent))
    return held_out.sums(data.test, _errors(linear, data, data.test))[0]


def _linear(data: ScaledDataset, layers: tuple[Layers, Layers]) -> Encoder:
    return Encoder({"name": "linear"}, data.scaler, *layers)


def _compared_with_pca(latent: int, sums: Array, held_out: HeldOut) -> dict[str, Any]:
    linear = _pca(held_out, latent)
    ratio = bootstrap(lambda ours, pca: ours.sum(axis=-1) / pca.sum(axis=-1), sums, linear)
    return {
        "pca_mse": bootstrap(_mean, linear, held_out.row_counts).tolist(),
        "ratio_to_pca": ratio.tolist() if latent < held_out.data.task.size else None,
    }


def _by_feature(sums: Array, held_out: HeldOut) -> list[dict[str, Any]]:
    data, rows = held_out.data, held_out.row_counts
    total, squares = held_out.variation
    width = data.scaler.half_width.astype(float)
    mse = bootstrap(lambda e, n: e / n, sums, rows).tolist()
    rmse = bootstrap(lambda e, n: np.sqrt(e / n) * width, sums, rows).tolist()
    r2 = bootstrap(
        lambda e, t, s, n: r_squared(e, variation(t, s, n)), sums, total, squares, rows
    ).tolist()
    return [
        {"name": f.name, "unit": f.unit, "mse": mse[i], "rmse_physical": rmse[i], "r2": r2[i]}
        for i, f in enumerate(data.task.features)
    ]


def _worst(sums: Array, held_out: HeldOut) -> list[dict[str, Any]]:
    """The episodes with the largest mean errors."""
    errors = _mean(sums, np.maximum(held_out.row_counts, 1))
    order = np.argsort(-errors, kind="stable")[:_WORST]
    seeds = held_out.data.dataset.episodes["seed"]
    return [
        {
            "episode": int(held_out.numbers[i]),
            "seed": int(seeds[held_out.numbers[i]]),
            "mse": float(errors[i]),
        }
        for i in order
    ]
