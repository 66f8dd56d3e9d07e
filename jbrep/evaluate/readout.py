"""What can be read from a latent: the robot's state, and the next latent."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.scaled import sample
from jbrep.encoders import Encoder
from jbrep.evaluate.held_out import HeldOut, Rows
from jbrep.evaluate.truth import quantities, state
from jbrep.stats.bootstrap import Array, Interval, bootstrap, r_squared, variation

_ROWS = 100_000  # at most, to fit on and to judge on
_CORRELATED = 50_000  # held-out rows
_QUERIES = 5_000  # held-out rows whose neighbours are looked up
_REFERENCES = 20_000  # training rows among which they are
_NEIGHBOURS = 5
_NEGLIGIBLE = 1e-6  # variance, as a share of the largest
_ROUNDING = 1e-12  # variance that rounding alone can cause
_PENALTY = 1.0  # of the ridge, on standardised latents


def probes(encoder: Encoder, held_out: HeldOut) -> dict[str, list[Any]]:
    """R^2 of a ridge regression of each quantity on the latent, fitted on training rows.

    The cosine and sine of an angle count together.
    """
    data = held_out.data
    train, test = sample(data.train, _ROWS), sample(data.test, _ROWS)
    seen, unseen = data.dataset["observation"][train], data.dataset["observation"][test]
    known, true = (quantities(data.task, rows) for rows in (seen, unseen))
    latents, unseen_latents = encoder.encode(seen), encoder.encode(unseen)
    scores = {}
    for name, values in known.items():
        predicted = _ridge().fit(latents, values).predict(unseen_latents)
        scores[name] = _explained(predicted, true[name], test, held_out).tolist()
    return scores


def dynamics(encoder: Encoder, held_out: HeldOut) -> dict[str, list[Any]]:
    """R^2 of the next latent: predicted linearly from latent and action, and as unchanged.

    The latent is whitened first, so that every direction in which it varies counts alike, however
    its units are scaled and mixed.
    """
    data = held_out.data
    steps = []
    for rows in (data.train, data.test):
        chosen = held_out.followed(sample(rows, _ROWS))
        now, then = (encoder.encode(data.dataset["observation"][r]) for r in (chosen, chosen + 1))
        steps.append((chosen, now, data.dataset["action"][chosen], then))
    whitened = _whitening(steps[0][1])
    steps = [(rows, whitened(now), act, whitened(then)) for rows, now, act, then in steps]
    (_, *known), (test, now, action, then) = steps
    predicted = _ridge().fit(np.hstack(known[:2]), known[2]).predict(np.hstack((now, action)))
    return {
        "linear": _explained(predicted, then, test, held_out).tolist(),
        "persistence": _explained(now, then, test, held_out).tolist(),
    }


def _whitening(latents: NDArray[Any]) -> Callable[[NDArray[Any]], Array]:
    """A map to uncorrelated directions of unit variance, leaving out constant ones.

    If all are constant, one direction is left, and it is 0.
    """
    mean = latents.mean(axis=0, dtype=np.float64)
    variances, directions = np.linalg.eigh(np.cov(latents.T).reshape(len(mean), -1))
    kept = variances > max(_NEGLIGIBLE * variances[-1], _ROUNDING)
    scales = np.where(kept, 1 / np.sqrt(np.where(kept, variances, 1)), 0)
    matrix = (directions * scales)[:, kept | (np.arange(len(kept)) == len(kept) - 1)]
    return lambda values: (values - mean) @ matrix


def _ridge() -> Any:
    from sklearn.linear_model import Ridge  # not at the top: it takes seconds
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), Ridge(_PENALTY))


def neighbours(encoder: Encoder, held_out: HeldOut) -> dict[str, Any]:
    """How similar the states of nearest neighbours in the latent are (KNN-MSE).

    The mean squared difference between a held-out row's state and those of its 5 nearest
    neighbours, as in the S-RL Toolbox (Raffin et al. 2018), but for thousands of rows rather than
    five, over the whole state with every dimension standardised, and with neighbours from training
    episodes only, never from the same episode. Unrelated rows give 2.
    """
    from sklearn.neighbors import NearestNeighbors

    data = held_out.data
    test, train = sample(data.test, _QUERIES), sample(data.train, _REFERENCES)
    queries, references = (data.dataset["observation"][rows] for rows in (test, train))
    query_states, reference_states = (
        np.stack(list(state(data.task, rows).values()), 1) for rows in (queries, references)
    )
    scale = reference_states.std(axis=0)
    varying = np.ptp(reference_states, axis=0) > 0
    index = NearestNeighbors(n_neighbors=min(_NEIGHBOURS, len(train)))
    index.fit(encoder.encode(references))
    nearest = index.kneighbors(encoder.encode(queries), return_distance=False)
    differences = (reference_states[nearest] - query_states[:, None])[..., varying] / scale[varying]
    squares = np.square(differences).mean(axis=1)
    sums, counts = held_out.sums(test, squares, np.ones((len(test), 1)))
    by_name = bootstrap(lambda s, n: s / n, sums, counts).tolist()
    names = np.array(list(state(data.task, references[:1])))[varying].tolist()
    return {
        "mse": bootstrap(lambda s, n: s.mean(axis=-1) / n[..., 0], sums, counts).tolist(),
        "dimensions": dict(zip(names, by_name, strict=True)),
    }


def correlation(encoder: Encoder, held_out: HeldOut) -> dict[str, Any]:
    """How directly single units show the state: the ground-truth correlation (GTC).

    For each dimension of the state, the largest absolute correlation with a unit of the latent; as
    in the S-RL Toolbox, but other dimensions of the state are not counted as units.
    """
    data = held_out.data
    test = sample(data.test, _CORRELATED)
    observation = data.dataset["observation"][test]
    truth = state(data.task, observation)
    left, right = encoder.encode(observation), np.stack(list(truth.values()), 1)
    z, s = (np.asarray(v - v.mean(axis=0), np.float64) for v in (left, right))
    products = (z[:, :, None] * s[:, None, :]).reshape(len(test), -1)
    sums = held_out.sums(test, z, s, z**2, s**2, products, np.ones((len(test), 1)))

    def largest(z: Array, s: Array, zz: Array, ss: Array, zs: Array, n: Array) -> Array:
        spread_z, spread_s = variation(z, zz, n), variation(s, ss, n)
        shared = zs.reshape(*z.shape, -1) - z[..., :, None] * s[..., None, :] / n[..., None]
        spread = np.sqrt(spread_z[..., :, None] * spread_s[..., None, :])
        return np.where(spread > 0, np.abs(shared) / spread, 0).max(axis=-2)

    by_name = bootstrap(largest, *sums).tolist()
    return {
        "mean": bootstrap(lambda *sums: largest(*sums).mean(axis=-1), *sums).tolist(),
        "dimensions": dict(zip(truth, by_name, strict=True)),
    }


def _explained(
    predicted: NDArray[Any], true: NDArray[Any], rows: Rows, held_out: HeldOut
) -> Interval:
    """R^2 of predicted columns (n, k), all together."""
    true = np.asarray(true, np.float64)
    predicted = predicted.reshape(true.shape)  # scikit-learn gives one column as (n,)
    shifted = true - true.mean(axis=0)  # keeps the digits of a small variation
    sums = held_out.sums(
        rows, (predicted - true) ** 2, shifted, shifted**2, np.ones((len(rows), 1))
    )

    def statistic(residual: Array, total: Array, squares: Array, n: Array) -> Array:
        return r_squared(residual.sum(axis=-1), variation(total, squares, n).sum(axis=-1))

    return bootstrap(statistic, *sums)
