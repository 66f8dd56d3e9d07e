"""What a latent looks like, and what can be read from it: the robot's state, what comes next.

Everything is measured on samples of rows, fewer where rows are wide: no array has more than
MAX_NUMBERS numbers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from jbrep.dataset.scaled import sample
from jbrep.encoders import Encoder
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Task
from jbrep.evaluate.evaluation import (
    Correlation,
    Dynamics,
    IntrinsicDimension,
    LatentUnits,
    Neighbours,
    Score,
    Scores,
    score,
    scores,
)
from jbrep.evaluate.held_out import (
    MAX_GROUPS,
    MAX_NUMBERS,
    HeldOut,
    Rows,
    explained,
    sample_rows,
)
from jbrep.evaluate.prediction import changes
from jbrep.evaluate.regression import Predictor, Problem, ridge
from jbrep.evaluate.truth import Columns, quantities, quantities_and_features, state
from jbrep.stats.bootstrap import Array, bootstrap, variation, without_nan

_ROWS = 100_000  # at most, to fit on and to judge on
_CORRELATED = 50_000  # held-out rows
_QUERIES = 5_000  # held-out rows whose neighbours are looked up
_REFERENCES = 20_000  # training rows among which they are
_NEIGHBOURS = 5
_NEGLIGIBLE = 1e-6  # variance of standardised units, as a share of the largest
_UNIT_ROWS = 200_000  # held-out rows
_POINTS = 4_000  # for intrinsic dimensions
_SATURATED = 0.95  # magnitude of a tanh unit
_DEAD = 0.01  # standard deviation, as a share of the most variable unit's
_STILL = 1e-6  # standard deviation that rounding alone can cause
_MLE_NEIGHBOURS = 20  # of the maximum-likelihood estimator
_DECIMALS = 6  # of the largest magnitude: finer, single precision only holds rounding
_UNKNOWN = Score(None, None, None)


def latent_units(encoder: BaseEncoder, held_out: HeldOut) -> LatentUnits:
    """Units, their correlations, and dimensions of the latent, over a sample of held-out rows.

    At most 200,000 rows, fewer where the latent has more than 41 units; for the intrinsic dimension
    4,000. The participation ratio is (sum of the covariance's eigenvalues)^2 / sum of their
    squares.
    """
    rows = sample_rows(held_out.data.test, _UNIT_ROWS, encoder.latent_size)
    values = encode(encoder, held_out, rows).astype(np.float64)
    deviation = values.std(axis=0)
    live = deviation > max(_DEAD * deviation.max(), _STILL)
    return LatentUnits(
        mean=values.mean(axis=0).tolist(),
        variance=(deviation**2).tolist(),
        dead=tuple(np.flatnonzero(~live).tolist()),
        saturation=_saturation(encoder, values),
        correlation=_unit_correlation(values, live),
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


def _unit_correlation(values: NDArray[np.float64], live: NDArray[np.bool_]) -> Any:
    """Pearson's correlation of the units, (l, l); None for dead ones."""
    matrix = np.full((len(live), len(live)), np.nan)
    matrix[np.ix_(live, live)] = np.corrcoef(values[:, live].T)
    return without_nan(matrix.tolist())


def intrinsic_dimension(values: NDArray[Any]) -> IntrinsicDimension:
    """Estimates of how many dimensions points (n, k) fill locally, from scikit-dimension.

    TwoNN (Facco et al. 2017) and the maximum likelihood of Levina and Bickel (2005). Points that
    only rounding tells apart count once. None where there are too few distinct points.
    """
    from skdim.id import MLE, TwoNN  # not at the top: it takes seconds

    largest = np.abs(values).max(initial=np.finfo(float).tiny)
    points = np.unique(np.round(values / largest, _DECIMALS), axis=0)
    if len(points) <= 2 * _MLE_NEIGHBOURS:
        return IntrinsicDimension(two_nn=None, mle=None)
    points = np.pad(points, ((0, 0), (0, 1)))  # the library refuses a single column
    estimates = TwoNN().fit(points).dimension_, MLE(K=_MLE_NEIGHBOURS).fit(points).dimension_
    two_nn, mle = without_nan([float(estimate) for estimate in estimates])
    return IntrinsicDimension(two_nn=two_nn, mle=mle)


def probes(encoder: BaseEncoder, held_out: HeldOut) -> Scores:
    """R^2 of a ridge regression of each quantity on the latent, fitted on training rows.

    The cosine and sine of an angle count together. At most 100,000 rows are fitted to, and as many
    judged; of more than 83 features, fewer.
    """
    fitted_to = _problem(encoder, held_out, quantities)
    return _probes(encoder, held_out, quantities, ridge(fitted_to.values, fitted_to.wanted))


def problem(encoder: BaseEncoder, held_out: HeldOut) -> Problem:
    """Each quantity and every feature, from the latent."""
    return _problem(encoder, held_out, quantities_and_features)


def nonlinear_probes(encoder: BaseEncoder, held_out: HeldOut, predict: Predictor) -> Scores:
    """R^2 as `probes`, by what was fitted to `problem`."""
    return _probes(encoder, held_out, quantities_and_features, predict)


_Truth = Callable[[Task, NDArray[Any]], Columns]


def _problem(encoder: BaseEncoder, held_out: HeldOut, truth: _Truth) -> Problem:
    seen, true = _true(held_out, held_out.data.train, truth)[1:]
    return Problem(encoder.encode(seen), np.hstack(list(true.values())))


def _probes(encoder: BaseEncoder, held_out: HeldOut, truth: _Truth, predict: Predictor) -> Scores:
    rows, unseen, true = _true(held_out, held_out.data.test, truth)
    widths = [values.shape[1] for values in true.values()]
    predicted, wanted = predict(encoder.encode(unseen)), np.hstack(list(true.values()))
    return dict(zip(true, explained(predicted, wanted, rows, held_out, widths), strict=True))


def _true(held_out: HeldOut, rows: Rows, truth: _Truth) -> tuple[Rows, NDArray[Any], Columns]:
    """A sample of rows, the observations there, and what is true: what isn't seen, too."""
    data = held_out.data
    chosen = sample_rows(rows, _ROWS, data.task.size)
    seen = data.dataset["observation"][chosen]
    return chosen, seen, {**truth(data.task, seen), **held_out.truth(chosen)}


class _Steps(NamedTuple):
    """Some rows that have a next one, with what leads to it."""

    rows: Rows  # (n,)
    latent: NDArray[Any]  # (n, l)
    action: NDArray[Any]  # (n, k)
    next_latent: NDArray[Any]  # (n, l)
    change: NDArray[Any]  # of the observation to the next one, (n, d)


def dynamics(encoder: BaseEncoder, held_out: HeldOut) -> Dynamics:
    """How well latent and action predict, by a ridge regression, what comes next.

    R^2 of the next latent, predicted from latent and action, and predicted as unchanged; and R^2 of
    the change of the observation from latent and action, each feature's change scaled to unit
    variance. The latent is whitened first, so that every direction in which it varies counts alike,
    however its units are scaled and mixed.

    Fitted to at most 100,000 training rows and judged on as many held-out ones, fewer of more than
    83 features; the last row of an episode is left out. None where fewer than two are left.
    """
    data = held_out.data
    seen, unseen = (_steps(encoder, held_out, rows) for rows in (data.train, data.test))
    if min(len(seen.rows), len(unseen.rows)) < 2:
        return Dynamics(linear=_UNKNOWN, persistence=_UNKNOWN, change=_UNKNOWN)
    whitened = _whitening(seen.latent)
    spread = seen.change.std(axis=0, dtype=np.float64)
    spread[spread == 0] = 1
    before, now = (np.hstack((whitened(s.latent), s.action)) for s in (seen, unseen))
    after, then = whitened(seen.next_latent), whitened(unseen.next_latent)
    width = after.shape[1]
    fitted = ridge(before, np.hstack((after, seen.change / spread)))(now)

    def judged(predicted: Array, true: Array) -> Score:
        return explained(predicted, true, unseen.rows, held_out)[0]

    return Dynamics(
        linear=judged(fitted[:, :width], then),
        persistence=judged(now[:, :width], then),
        change=judged(fitted[:, width:], unseen.change / spread),
    )


def _steps(encoder: BaseEncoder, held_out: HeldOut, rows: Rows) -> _Steps:
    dataset = held_out.data.dataset
    width = max(held_out.data.task.size, encoder.latent_size)
    chosen = held_out.followed(sample_rows(rows, _ROWS, width))
    latent, next_latent = (encoder.encode(dataset["observation"][r]) for r in (chosen, chosen + 1))
    change = changes(held_out.data.task, dataset["observation"], chosen, 1)
    return _Steps(chosen, latent, dataset["action"][chosen], next_latent, change)


def _whitening(latents: NDArray[Any]) -> Callable[[NDArray[Any]], Array]:
    """A map of latents (n, l) to uncorrelated directions of unit variance, without constant ones.

    Units are standardised first, so that their scales don't say which directions are constant. If
    all are, one direction is left, and it is 0.
    """
    mean = latents.mean(axis=0, dtype=np.float64)
    deviation = latents.std(axis=0, dtype=np.float64)
    magnitude = np.maximum(np.abs(latents).max(axis=0), deviation.max())
    factor = _inverse(deviation, deviation > np.finfo(np.float32).eps * magnitude)
    standardised = (latents - mean) * factor
    variances, directions = np.linalg.eigh(np.cov(standardised.T).reshape(len(mean), -1))
    kept = variances > _NEGLIGIBLE * variances[-1]
    scales = _inverse(np.sqrt(np.maximum(variances, 0)), kept)
    matrix = (directions * scales)[:, kept | (np.arange(len(kept)) == len(kept) - 1)]
    return lambda values: (values - mean) * factor @ matrix


def _inverse(values: Array, kept: NDArray[np.bool_]) -> Array:
    """1 / values of those that are kept, 0 of the others, (n,)."""
    return np.divide(1, values, out=np.zeros(len(values)), where=kept)


def neighbours(encoder: BaseEncoder, held_out: HeldOut) -> Neighbours:
    """How similar the states of nearest neighbours in the latent are (KNN-MSE).

    The mean squared difference between a held-out row's state and those of its 5 nearest
    neighbours, as in the S-RL Toolbox (Raffin et al. 2018), but for thousands of rows rather than
    five, over the whole state with every dimension standardised, and with neighbours from training
    episodes only, never from the same episode. Unrelated rows give 2.

    The rows are a sample of 5,000, their neighbours from one of 20,000; fewer of each of more than
    300 features.
    """
    from sklearn.neighbors import NearestNeighbors

    data = held_out.data
    size = max(data.task.size, encoder.latent_size)
    test = sample_rows(data.test, _QUERIES, _NEIGHBOURS * size)
    train = sample_rows(data.train, _REFERENCES, size)
    queries, references = (data.dataset["observation"][rows] for rows in (test, train))
    query_states, reference_states = (
        np.stack(list(state(data.task, rows).values()), 1) for rows in (queries, references)
    )
    scale = reference_states.std(axis=0)
    varying = np.ptp(reference_states, axis=0) > 0
    index = NearestNeighbors(n_neighbors=min(_NEIGHBOURS, len(train)))
    index.fit(encoder.encode(references))
    latents = encoder.encode(queries)
    with threadpool_limits(1, "openmp"):  # of this thread: which of equally near ones depends on it
        nearest = index.kneighbors(latents, return_distance=False)
    differences = (reference_states[nearest] - query_states[:, None])[..., varying] / scale[varying]
    squares = np.square(differences).mean(axis=1)
    sums, counts = held_out.sums(test, squares, np.ones((len(test), 1)))
    by_name = scores(bootstrap(lambda s, n: s / n, sums, counts))
    names = np.array(list(state(data.task, references[:1])))[varying].tolist()
    return Neighbours(
        mse=score(bootstrap(lambda s, n: s.mean(axis=-1) / n[..., 0], sums, counts)),
        dimensions=dict(zip(names, by_name, strict=True)),
    )


def correlation(encoder: BaseEncoder, held_out: HeldOut) -> Correlation:
    """How directly single units show the state: the ground-truth correlation (GTC).

    For each dimension of the state, the largest absolute correlation with a unit of the latent; as
    in the S-RL Toolbox, but other dimensions of the state are not counted as units. None of one
    that doesn't vary; the mean is over the others.

    Its cost grows as latent units times dimensions of the state, so of a robot with more than 128
    features, or a latent with more units, only some dimensions are looked at: 48 of 348. They are
    the same ones for every encoder that has no more units than the robot has features.
    `state_dimensions` says how many there are. The rows are a sample of at most 50,000.
    """
    data = held_out.data
    size = max(data.task.size, encoder.latent_size)
    test = sample_rows(data.test, _CORRELATED, size)
    observation = data.dataset["observation"][test]
    truth = state(data.task, observation)
    names = sample(np.array(list(truth)), max(1, 2 * MAX_NUMBERS // (MAX_GROUPS * size))).tolist()
    left, right = encoder.encode(observation), np.stack([truth[name] for name in names], 1)
    z, s = (np.asarray(v - v.mean(axis=0), np.float64) for v in (left, right))
    sums = held_out.sums(test, z, s, z**2, s**2, np.ones((len(test), 1)))
    products = np.stack([z[rows].T @ s[rows] for rows in held_out.slices(test)])

    def largest(z: Array, s: Array, zz: Array, ss: Array, n: Array, zs: Array) -> Array:
        spread_z, spread_s = variation(z, zz, n), variation(s, ss, n)
        shared = zs - z[..., :, None] * s[..., None, :] / n[..., None]
        spread = np.sqrt(spread_z[..., :, None] * spread_s[..., None, :])
        by_name = np.where(spread > 0, np.abs(shared) / spread, 0).max(axis=-2)
        varies = spread_s > 0
        mean = by_name.sum(axis=-1, keepdims=True) / varies.sum(axis=-1, keepdims=True)
        return np.append(np.where(varies, by_name, np.nan), mean, axis=-1)

    *by_name, mean = scores(bootstrap(largest, *sums, products))
    return Correlation(
        mean=mean,
        dimensions=dict(zip(names, by_name, strict=True)),
        state_dimensions=len(truth),
    )
