"""What a latent looks like, and what can be read from it: the robot's state, what comes next.

Everything is measured on samples of rows, fewer where rows are wide: see `sample_rows`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Task
from jbrep.evaluation.evaluation import Judged, LatentUnits, Scalar, Score, Scores, diagnostic
from jbrep.evaluation.held_out import HeldOut, Rows, explained, sample_rows
from jbrep.evaluation.prediction import changes
from jbrep.evaluation.regression import Predictor, Problem, ridge
from jbrep.jitterbug.tasks import TASKS
from jbrep.stats.bootstrap import Array

Columns = dict[str, Array]
_Truth = Callable[[Task, NDArray[Any]], Columns]

_ROWS = 100_000  # at most, to fit on and to judge on
_NEGLIGIBLE = 1e-6  # variance of standardised units, as a share of the largest
_UNIT_ROWS = 200_000  # held-out rows
_DEAD = 0.01  # standard deviation, as a share of the most variable unit's
_STILL = 1e-6  # standard deviation that rounding alone can cause
_ROTATION = ("orientation_w", "orientation_x", "orientation_y", "orientation_z")
_NEEDED = {*_ROTATION, "velocity_x", "velocity_y", "motor_angle"}  # features, for the quantities


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
    return Score(float(len(units.dead))), Score(units.participation_ratio)


def quantities(task: Task, observation: ArrayLike) -> Columns:
    """What a controller needs to know from observations (n, d) in physical units.

    An angle is its cosine and sine, (n, 2); the rest is (n, 1). Of the Jitterbug: the heading of
    its face in the world, its uprightness (cosine of the tilt), its forward speed [m/s], the
    motor's phase, and, if the task has them, the angle to the target's yaw and the bearing of the
    target's position from the face, counter-clockwise. Of any other robot: every feature; it is an
    angle if its unit is rad and it is bounded to one turn.
    """
    is_known = task.name in TASKS and {*task.feature_names} >= _NEEDED and not task.offset.any()
    return _jitterbug(_features(task, observation)) if is_known else every(task, observation)


def quantities_and_features(task: Task, observation: ArrayLike) -> Columns:
    """The quantities, then the features that aren't among them; all angles as cosine and sine."""
    known, features = quantities(task, observation), every(task, observation)
    return known | {name: features[name] for name in features if name not in known}


def every(task: Task, observation: ArrayLike) -> Columns:
    """All features, (n, k) by name: angles as cosine and sine."""
    angles = {feature.name for feature in task.features if feature.is_full_turn}
    return {
        name: _on_circle(column) if name in angles else column[:, None]
        for name, column in _features(task, observation).items()
    }


def _features(task: Task, observation: ArrayLike) -> Columns:
    columns = np.asarray(observation, np.float64).T
    return dict(zip(task.feature_names, columns, strict=True))


def _jitterbug(f: Columns) -> Columns:
    w, x, y, z = (f[name] for name in _ROTATION)
    face = _direction(2 * (w * z - x * y), 2 * (x * x + z * z) - 1)  # the robot's -Y axis
    speed = face[:, 0] * f["velocity_x"] + face[:, 1] * f["velocity_y"]
    columns = {
        "heading": face,
        "uprightness": (1 - 2 * (x * x + y * y))[:, None],
        "forward_speed": speed[:, None],
        "motor_phase": _on_circle(f["motor_angle"]),
    }
    if "angle_to_target" in f:
        columns["angle_to_target"] = _on_circle(f["angle_to_target"])
    if "target_x" in f:
        columns["bearing_of_target"] = _direction(-f["target_y"], f["target_x"])
    return columns


def _on_circle(angle: Array) -> Array:
    return np.stack((np.cos(angle), np.sin(angle)), axis=1)


def _direction(x: Array, y: Array) -> Array:
    """Unit vectors along (x, y), (n, 2); zero vectors stay zero."""
    length = np.maximum(np.hypot(x, y), 1e-12)
    return np.stack((x / length, y / length), axis=1)


def probe_problem(
    encoder: BaseEncoder, held_out: HeldOut, truth: _Truth = quantities_and_features
) -> Problem:
    """What is true, by default each quantity and every feature, from the latent."""
    seen, true = _true(held_out, held_out.data.train, truth)[1:]
    return Problem(encoder.encode(seen), np.hstack(list(true.values())))


def probes(encoder: BaseEncoder, held_out: HeldOut, predict: Predictor | None = None) -> Scores:
    """R^2 of each quantity by a ridge regression on the latent, fitted on training rows.

    By what was fitted to `probe_problem`, of every feature, too. The cosine and sine of an angle
    count together. At most 100,000 rows are fitted to, and as many judged; of more than 83
    features, fewer.
    """
    truth = quantities_and_features if predict else quantities
    predict = predict or ridge(*probe_problem(encoder, held_out, truth)[:2])
    rows, unseen, true = _true(held_out, held_out.data.test, truth)
    widths = [values.shape[1] for values in true.values()]
    predicted, wanted = predict(encoder.encode(unseen)), np.hstack(list(true.values()))
    return dict(zip(true, explained(predicted, wanted, rows, held_out.sums, widths), strict=True))


def _true(held_out: HeldOut, rows: Rows, truth: _Truth) -> tuple[Rows, NDArray[Any], Columns]:
    """A sample of rows, the observations there, and what is true: what isn't seen, too."""
    data = held_out.data
    chosen = sample_rows(rows, _ROWS, data.task.size)
    seen = data.dataset["observation"][chosen]
    true = truth(data.task, seen)
    if shown := held_out.shown:
        known = every(shown.task, shown["observation"][chosen])
        true |= {name: known[name] for name in held_out.hidden}
    return chosen, seen, true


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
    data, encode = e.held_out.data, e.encoder.encode
    width = max(data.task.size, e.encoder.latent_size)
    fitted_to, rows = (
        e.held_out.followed(sample_rows(part, _ROWS, width)) for part in (data.train, data.test)
    )
    if min(len(fitted_to), len(rows)) < 2:
        return Score(None), Score(None), Score(None)
    observation, action = data.dataset["observation"], data.dataset["action"]
    whitened = _whitening(encode(observation[fitted_to]))
    change = changes(data.task, observation, fitted_to, 1)
    spread = change.std(axis=0, dtype=np.float64)
    spread[spread == 0] = 1
    before, now = (
        np.hstack((whitened(encode(observation[r])), action[r])) for r in (fitted_to, rows)
    )
    after, then = (whitened(encode(observation[r + 1])) for r in (fitted_to, rows))
    width = after.shape[1]
    predicted = ridge(before, np.hstack((after, change / spread)))(now)

    def judged(predicted: Array, true: Array) -> Score:
        return explained(predicted, true, rows, e.held_out.sums)[0]

    return (
        judged(predicted[:, :width], then),
        judged(now[:, :width], then),
        judged(predicted[:, width:], changes(data.task, observation, rows, 1) / spread),
    )


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
    return np.divide(1, values, out=np.zeros(len(values)), where=kept)
