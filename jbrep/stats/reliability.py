"""How steadily runs learn, after Chan et al. 2020.

"Measuring the Reliability of Reinforcement Learning Algorithms", ICLR 2020: dispersion is an
interquartile range, risk an expected shortfall. Both are taken over a curve's differences from one
evaluation to the next, which removes the trend; long-term risk is taken over its drawdown. They
depend on the distance between evaluations, so compare them only within one grid.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import iqr

from jbrep.stats.bootstrap import Array
from jbrep.stats.runs import RunCurve

TAIL = 0.05  # of a run's evaluations, or episodes
TAIL_OF_RUNS = 0.25  # a smaller part of so few runs would be the worst run alone


def expected_shortfall(values: Array, tail: float) -> Array:
    """The mean of the lowest part of (..., n), also called CVaR.

    A value on the edge of the tail counts in part (Rockafellar and Uryasev 2002,
    "Conditional value-at-risk for general loss distributions"); a tail of less than one value is
    the lowest.
    """
    ordered = np.sort(values, axis=-1)
    mass = tail * values.shape[-1]
    if mass <= 1:
        return ordered[..., 0]
    weights = np.clip(mass - np.arange(values.shape[-1]), 0, 1)
    return ordered @ weights / mass


def drawdown(curves: Array) -> Array:
    """Curves (..., g) minus their running maximum, at most 0."""
    return curves - np.maximum.accumulate(curves, axis=-1)


def within_runs(curves: Array, failed: NDArray[np.bool_]) -> dict[str, Array]:
    """Dispersion and risk over the training of each run, from curves (runs, g), (runs,) each.

    NaN for a run that failed, (runs,): its constant return would look like steadiness.
    """
    steps = np.diff(curves, axis=1)
    fallen = drawdown(curves)
    numbers = {
        "dispersion_across_time": iqr(steps, axis=1),
        "short_term_risk": expected_shortfall(steps, TAIL),
        "long_term_risk": expected_shortfall(fallen, TAIL),
        "largest_drawdown": fallen.min(axis=1),
    }
    return {name: np.where(failed, np.nan, values) for name, values in numbers.items()}


def fixed_policy(runs: list[RunCurve], end: float) -> dict[str, Array]:
    """Dispersion and risk over the episodes of each run's last evaluation, (runs,) each.

    That is the last one up to a step; NaN for a failed run.
    """
    numbers = {
        "policy_dispersion": np.full(len(runs), np.nan),
        "policy_risk": np.full(len(runs), np.nan),
    }
    for i, run in enumerate(runs):
        if run.failed_at is None:
            last = run.evaluations[np.flatnonzero(run.steps <= end)[-1]]
            numbers["policy_dispersion"][i] = iqr(last)
            numbers["policy_risk"][i] = expected_shortfall(last, TAIL)
    return numbers
