"""What a latent looks like, and what can be read from it of the robot's state.

Everything is measured on samples of rows, fewer where rows are wide: see `sample_rows`.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Task
from jbrep.evaluation.evaluation import Judged, LatentUnits, Scalar, Score, Scores, diagnostic
from jbrep.evaluation.held_out import HeldOut, Rows, explained, sample_rows
from jbrep.evaluation.regression import Predictor, Problem
from jbrep.stats.bootstrap import Array

Columns = dict[str, Array]
_ROWS = 100_000  # at most, to fit on and to judge on
_UNIT_ROWS = 200_000  # held-out rows
_DEAD = 0.01  # standard deviation, as a share of the most variable unit's
_STILL = 1e-6  # standard deviation that rounding alone can cause


def latent_units(encoder: BaseEncoder, held_out: HeldOut) -> LatentUnits:
    """How units are used, over at most 200,000 held-out rows, fewer of more than 41 units.

    The participation ratio is (sum of the covariance's eigenvalues)^2 / sum of their squares.
    """
    rows = sample_rows(held_out.data.test, _UNIT_ROWS, encoder.latent_size)
    parts = [encoder.encode(chunk) for chunk in held_out.data.observations(rows)]
    values = np.concatenate(parts).astype(np.float64)
    deviation = values.std(axis=0)
    live = deviation > max(_DEAD * deviation.max(), _STILL)
    ratio = None
    if live.any():
        spectrum = np.linalg.eigvalsh(np.atleast_2d(np.cov(values.T)))
        ratio = float(spectrum.sum() ** 2 / np.square(spectrum).sum())
    return LatentUnits(
        mean=values.mean(axis=0).tolist(),
        variance=(deviation**2).tolist(),
        dead=tuple(np.flatnonzero(~live).tolist()),
        participation_ratio=ratio,
    )


@diagnostic(
    Scalar("dead", "units that hardly vary", better=-1),
    Scalar("participation", "how many directions the latent fills (participation ratio)"),
)
def usage(e: Judged) -> tuple[Score, Score]:
    """As `latent_units` has it."""
    units = e.known.latent_units
    return Score(float(len(units.dead))), Score(units.participation_ratio)


def every(task: Task, observation: ArrayLike) -> Columns:
    """All features, (n, k) by name: angles as cosine and sine."""
    columns = np.asarray(observation, np.float64).T
    return {
        feature.name: np.column_stack(
            (np.cos(column), np.sin(column)) if feature.is_full_turn else (column,)
        )
        for feature, column in zip(task.features, columns, strict=True)
    }


def probe_problem(encoder: BaseEncoder, held_out: HeldOut) -> Problem:
    """Every feature, from the latent."""
    _, seen, true = _true(held_out, held_out.data.train)
    return Problem(encoder.encode(seen), np.hstack(list(true.values())))


def probes(encoder: BaseEncoder, held_out: HeldOut, predict: Predictor) -> Scores:
    """R^2 of each feature by what was fitted to `probe_problem`.

    The cosine and sine of an angle count together. At most 100,000 rows are fitted to, and as many
    judged; of more than 83 features, fewer.
    """
    rows, unseen, true = _true(held_out, held_out.data.test)
    widths = [values.shape[1] for values in true.values()]
    predicted, wanted = predict(encoder.encode(unseen)), np.hstack(list(true.values()))
    return dict(zip(true, explained(predicted, wanted, rows, held_out.sums, widths), strict=True))


def _true(held_out: HeldOut, rows: Rows) -> tuple[Rows, NDArray[Any], Columns]:
    """A sample of rows, the observations there, and all features, also those that aren't seen."""
    data = held_out.data
    chosen = sample_rows(rows, _ROWS, data.task.size)
    seen = data.dataset["observation"][chosen]
    true = every(data.task, seen)
    if shown := held_out.shown:
        known = every(shown.task, shown["observation"][chosen])
        true |= {name: known[name] for name in held_out.hidden}
    return chosen, seen, true


@diagnostic(Scalar("nonlinear_probes", "mean R² of nonlinear probes of the state"))
def mean_probes(e: Judged) -> Score:
    """Over the features that vary."""
    known = [score.value for score in e.known.nonlinear_probes.values() if score.value is not None]
    return Score(sum(known) / len(known) if known else None)
