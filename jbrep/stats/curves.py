"""Learning curves on a grid of training steps that all compared runs share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.stats import trim_mean

from jbrep.errors import InputError
from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import percentile
from jbrep.stats.runs import Group, RunCurve

PERCENTILES = (10, 25, 50, 75, 90)
_LAST = 0.1  # of the grid's range, for the final return
_FIFTH = 0.2  # of training, at whose ends it is asked whether curves still rise
_FLAT = 0.03  # of the final return: a curve that rises by less in a fifth of training is flat
_POINTS = 64  # of the grid at a time, to keep the resamples in memory


@dataclass(frozen=True, eq=False)
class Curve:
    """Mean returns of a representation's runs at each step of the grid, (g,) each."""

    p10: Array  # 10th percentile over runs; the others likewise
    p25: Array
    p50: Array
    p75: Array
    p90: Array
    mean: Array  # over runs
    iqm: Interval  # interquartile mean over runs with its 95 % interval


def iqm(values: Array) -> Array:
    """The interquartile mean of (..., n): the mean of the middle half (Agarwal et al. 2021)."""
    return trim_mean(values, 0.25, axis=-1)


def common_grid(group: Group) -> tuple[Array, str | None]:
    """The training steps at which all runs of a group are compared, (g,), and what is cut off.

    The grid begins where the last run begins and ends where the first run that didn't fail ends:
    nothing is extrapolated. In between it has the evaluations of the run with the fewest, as more
    would only be interpolated.
    """
    runs = list(chain.from_iterable(group.values()))
    whole = [run for run in runs if run.failed_at is None]
    start = max(_first(run) for run in runs)
    end = min([int(run.steps[-1]) for run in whole] or [run.total_steps for run in runs])
    if start >= end:
        raise InputError(
            f"{runs[0].task}/{runs[0].algorithm}: the evaluations of one run end at step {end}, "
            f"those of another begin at {start}: compare runs whose steps overlap"
        )
    inside = [run.steps[(start < run.steps) & (run.steps < end)] for run in whole or runs]
    fewest = min(inside, key=lambda steps: (len(steps), *steps))
    return np.array([start, *fewest, end], float), _cut(whole, end)


def _first(run: RunCurve) -> int:
    """The first step of its curve: 0 if it failed before it was evaluated."""
    steps, _ = run.curve()
    return 0 if steps[0] == run.failed_at else int(steps[0])


def _cut(runs: list[RunCurve], end: int) -> str | None:
    longest = max((run.steps[-1] for run in runs), default=end)
    if longest == end:
        return None
    run = min((r for r in runs if r.steps[-1] == end), key=lambda r: (r.representation, r.seed))
    return (
        f"ends at step {end:,} with {run.representation}, seed {run.seed}; "
        f"the longest run has {longest:,}"
    )


def on_grid(run: RunCurve, grid: Array) -> Array:
    """The mean return of a run's evaluations at each step of the grid, (g,)."""
    return np.interp(grid, *run.curve())


def bands(curves: Array) -> Curve:
    """Percentiles and means of curves (runs, g) at each step, from resampling whole curves."""
    parts = [
        percentile(iqm, curves.T[first : first + _POINTS])
        for first in range(0, curves.shape[1], _POINTS)
    ]
    iqm_of_all = Interval(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    p10, p25, p50, p75, p90 = np.percentile(curves, PERCENTILES, axis=0)
    return Curve(p10, p25, p50, p75, p90, curves.mean(axis=0), iqm_of_all)


def final_return(curves: Array, grid: Array) -> Array:
    """The mean of curves (runs, g) over the evaluations in the last tenth of the grid's range."""
    start, end = grid[0], grid[-1]
    return curves[:, grid >= end - _LAST * (end - start)].mean(axis=1)


def _end_on_all_starts(group: Mapping[str, Sequence[RunCurve]], grid: Array) -> bool:
    """Whether final returns can be those of an evaluation of more episodes.

    All runs that didn't fail end with one on the grid, and the return that gains are counted over
    doesn't have to be read off the curves, which are of fewer episodes.
    """
    every = [run for runs in group.values() for run in runs]
    whole = [run for run in every if run.failed_at is None]
    is_known = all(r.reference is not None or r.return_floor is not None for r in every)
    ends = all(r.final is not None and r.steps[-1] <= grid[-1] for r in whole)
    return bool(whole) and is_known and ends


def _end(run: RunCurve, curve: Array) -> float:
    if run.failed_at is not None and run.failure_return is not None:
        return run.failure_return
    return float(curve[-1] if run.final is None else run.final.mean())


def _ends(runs: Sequence[RunCurve], curves: Array, grid: Array, on_all_starts: bool) -> Array:
    if on_all_starts:
        return np.array([*map(_end, runs, curves)])
    failed = [run.failed_at is not None and run.failed_at <= grid[-1] for run in runs]
    return np.where(failed, curves[:, -1], final_return(curves, grid))


class Compared(NamedTuple):
    """The runs of a group where they are compared."""

    grid: Array  # training steps, (g,)
    cut: str | None  # which evaluations it leaves out, in words; None if it leaves out none
    runs: Group  # the runs, the baseline's first
    # of each representation's runs on the grid, (runs, g)
    curves: dict[str, Array]
    finals: dict[str, Array]  # the final return of each of these runs, (runs,)
    # whether that is the mean of the last evaluation, of its starts, or by `final_return`; of a
    # run that has failed by then it is its failure_return
    on_all_starts: bool

    @property
    def of_baseline(self) -> Array:
        """The curves of the baseline, (runs, g)."""
        return next(iter(self.curves.values()))


def compared(group: Group) -> Compared:
    """The runs of a group on their common grid."""
    grid, cut = common_grid(group)
    curves = {n: np.stack([on_grid(run, grid) for run in runs]) for n, runs in group.items()}
    on_all_starts = _end_on_all_starts(group, grid)
    finals = {n: _ends(runs, curves[n], grid, on_all_starts) for n, runs in group.items()}
    return Compared(grid, cut, group, curves, finals, on_all_starts)


def rise(curves: Array, grid: Array) -> Array:
    """How much the mean evaluation in the last fifth of training is above that of the fifth before.

    Of each curve, (runs, g); NaN where there is no evaluation in one of the fifths.
    """
    fifth = _FIFTH * grid[-1]
    last = grid > grid[-1] - fifth
    before = (grid > grid[-1] - 2 * fifth) & ~last
    if not (last.any() and before.any()):
        return np.full(len(curves), np.nan)
    return curves[:, last].mean(axis=1) - curves[:, before].mean(axis=1)


def rises(by: Interval, final: float) -> bool:
    """Whether curves surely rise by so much in the last fifth, and not by a trifle."""
    return bool(by.low > 0 and by.value >= _FLAT * abs(final))


def mean_return(curves: Array, grid: Array) -> Array:
    """The area under curves (runs, g), divided by the grid's length: the mean over training."""
    return np.trapezoid(curves, grid, axis=1) / (grid[-1] - grid[0])


def steps_to(curves: Array, grid: Array, threshold: float) -> Array:
    """The first step at which each curve, (runs, g), reaches a return; inf if it never does.

    NaN for a threshold of NaN: there is nothing to reach.
    """
    if np.isnan(threshold):
        return np.full(len(curves), np.nan)
    above = curves >= threshold
    after = above.argmax(axis=1)  # also 0 where it is never reached
    before = np.maximum(after - 1, 0)
    rows = np.arange(len(curves))
    low, high = curves[rows, before], curves[rows, after]
    share = np.divide(threshold - low, high - low, out=np.zeros(len(curves)), where=high > low)
    crossing = grid[before] + np.clip(share, 0, 1) * (grid[after] - grid[before])
    return np.where(above.any(axis=1), crossing, np.inf)
