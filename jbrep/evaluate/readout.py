"""What a latent looks like, and what can be read from it: the robot's state, what comes next.

Everything is measured on samples of rows, fewer where rows are wide: see `sample_rows`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Task
from jbrep.evaluate.evaluation import LatentUnits, Score, Scores
from jbrep.evaluate.held_out import HeldOut, Rows, explained, sample_rows
from jbrep.evaluate.prediction import changes
from jbrep.evaluate.registry import Judged, Scalar, diagnostic
from jbrep.evaluate.regression import Predictor, Problem, ridge
from jbrep.evaluate.truth import Columns, quantities, quantities_and_features
from jbrep.stats.bootstrap import Array

_ROWS = 100_000  # at most, to fit on and to judge on
_NEGLIGIBLE = 1e-6  # variance of standardised units, as a share of the largest
_UNIT_ROWS = 200_000  # held-out rows
_DEAD = 0.01  # standard deviation, as a share of the most variable unit's
_STILL = 1e-6  # standard deviation that rounding alone can cause
_UNKNOWN = Score(None)


def latent_units(encoder: BaseEncoder, held_out: HeldOut) -> LatentUnits:
    """How units are used, over at most 200,000 held-out rows, fewer of more than 41 units.

    The participation ratio is (sum of the covariance's eigenvalues)^2 / sum of their squares.
    """
    rows = sample_rows(held_out.data.test, _UNIT_ROWS, encoder.latent_size)
    parts = [encoder.encode(chunk) for chunk in held_out.data.observations(rows)]
    values = np.concatenate(parts).astype(np.float64)
    deviation = values.std(axis=0)
    live = deviation > max(_DEAD * deviation.max(), _STILL)
    spectrum = np.linalg.eigvalsh(np.atleast_2d(np.cov(values.T)))
    ratio = float(spectrum.sum() ** 2 / np.square(spectrum).sum()) if live.any() else None
    return LatentUnits(
        mean=values.mean(axis=0).tolist(),
        variance=(deviation**2).tolist(),
        dead=tuple(np.flatnonzero(~live).tolist()),
        participation_ratio=ratio,
    )


@diagnostic(
    Scalar("dead", "units that hardly vary", better=-1),
    Scalar("participation", "how many directions the code fills (participation ratio)"),
)
def usage(e: Judged) -> tuple[Score, Score]:
    """As `latent_units` has it."""
    units = e.known.latent_units
    return Score(len(units.dead)), Score(units.participation_ratio)


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


@diagnostic(
    Scalar("probes", "mean R² of linear probes of the state"),
    Scalar("nonlinear_probes", "mean R² of nonlinear probes of the state"),
)
def mean_probes(e: Judged) -> tuple[Score, Score]:
    """Over those of what varies."""
    return _mean(e.known.probes), _mean(e.known.nonlinear_probes)


def _mean(scores: Scores) -> Score:
    known = [score.value for score in scores.values() if score.value is not None]
    return Score(sum(known) / len(known) if known else None)


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


@diagnostic(
    Scalar("next", "R² of the next latent, linear"),
    Scalar("persistence", "R² of the next latent, predicted to be this one"),
    Scalar("change", "R² of the features' next change, linear"),
)
def dynamics(e: Judged) -> tuple[Score, Score, Score]:
    """How well latent and action predict, by a ridge regression, what comes next.

    R^2 of the next latent, predicted from latent and action, and predicted as unchanged; and R^2 of
    the change of the observation from latent and action, each feature's change scaled to unit
    variance. The latent is whitened first, so that every direction in which it varies counts alike,
    however its units are scaled and mixed.

    Fitted to at most 100,000 training rows and judged on as many held-out ones, fewer of more than
    83 features; the last row of an episode is left out. None where fewer than two are left.
    """
    encoder, held_out, data = e.encoder, e.held_out, e.held_out.data
    seen, unseen = (_steps(encoder, held_out, rows) for rows in (data.train, data.test))
    if min(len(seen.rows), len(unseen.rows)) < 2:
        return _UNKNOWN, _UNKNOWN, _UNKNOWN
    whitened = _whitening(seen.latent)
    spread = seen.change.std(axis=0, dtype=np.float64)
    spread[spread == 0] = 1
    before, now = (np.hstack((whitened(s.latent), s.action)) for s in (seen, unseen))
    after, then = whitened(seen.next_latent), whitened(unseen.next_latent)
    width = after.shape[1]
    fitted = ridge(before, np.hstack((after, seen.change / spread)))(now)

    def judged(predicted: Array, true: Array) -> Score:
        return explained(predicted, true, unseen.rows, held_out)[0]

    return (
        judged(fitted[:, :width], then),
        judged(now[:, :width], then),
        judged(fitted[:, width:], unseen.change / spread),
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
