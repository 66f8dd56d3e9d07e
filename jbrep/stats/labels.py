"""The results of one representation: of each run, and of all runs together."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.stats import binomtest, chi2, f, iqr, median_abs_deviation

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.curves import Curve, bands, final_return, iqm, mean_return, rise, rises, steps_to
from jbrep.stats.intervals import (
    LEVEL,
    UNDEFINED,
    Bounds,
    deviation,
    mean_within,
    percentile,
    surely_above,
    unless_few,
)
from jbrep.stats.pairs import FEWEST_UNITS, Units, linked_units
from jbrep.stats.runs import RunCurve
from jbrep.stats.scale import STEPS_TO, Scale

YES, NO, UNCLEAR = "yes", "no", "unclear"
REACHED = {name: name.replace("steps_to", "reached") for name in STEPS_TO}
_TAIL = 0.25  # of runs: a smaller part of so few would be the worst run alone
# of the variance of final returns, where each of several encoders has several runs
COMPONENTS = ("encoder_variance", "run_variance", "encoder_variance_ratio")
_TAILS = (1 + LEVEL) / 2, (1 - LEVEL) / 2
_median = partial(np.median, axis=-1)


@dataclass(frozen=True, eq=False)
class RepresentationResult:
    """The runs of one representation, with one task and algorithm."""

    representation: str  # what the agent observed
    settings: str  # that all runs share
    seeds: tuple[int, ...]  # of the runs, in ascending order
    failed: tuple[int, ...]  # seeds of the runs that failed
    encoders: int  # how many they have among them
    # whether they end above the best blind baseline: yes, no, or unclear
    learnt: str
    curve: Curve  # over the grid of the group
    by_run: Mapping[str, Array]  # numbers of each run by name, (runs,) each, in the order of seeds
    numbers: Mapping[str, Interval]  # of all runs by name, each with its 95 % interval
    # the share of runs whose final return is above each of the group's profile_returns, (k,)
    profile: Interval

    @property
    def rises(self) -> bool:
        """Whether returns surely still rise at the end of training."""
        return rises(self.numbers["rise"], float(self.numbers["final_return_mean"].value))


def describe(
    runs: list[RunCurve], curves: Array, final: Array, scale: Scale
) -> RepresentationResult:
    """The results of a representation, from its runs in the order of seeds.

    The curves are on the grid of the scale, (runs, g); final returns are (runs,).
    """
    grid = scale.grid
    by_run = {
        "final_return": final,
        "mean_return": mean_return(curves, grid),
        "gain": final_return(curves, grid) - scale.ends.blind_in_training,
        **{name: steps_to(curves, grid, each) for name, each in scale.thresholds.items()},
        "score": scale.ends.score(final),
        "rise": rise(curves, grid),
    }
    encoders = linked_units([[run.encoder_seed for run in runs]])
    return RepresentationResult(
        representation=runs[0].representation,
        settings=runs[0].settings,
        seeds=tuple(int(run.seed) for run in runs),
        failed=tuple(int(run.seed) for run in runs if run.failed_at is not None),
        encoders=len({run.encoder_seed for run in runs}),
        learnt=learnt(of_units(final, encoders), scale.blind, runs[0].bounds),
        curve=bands(curves),
        by_run=by_run,
        numbers={**_numbers(by_run, encoders, runs[0].bounds), **_components(encoders, final)},
        profile=profile(by_run["final_return"], scale.profile_returns),
    )


def learnt(final: Array, blind: Interval, bounds: Bounds) -> str:
    """Whether final returns lie above a mean return beyond what is uncertain of either.

    If the interval of that return has no upper end, they are never surely above it.
    """
    if surely_above(final, blind.value, bounds) and not final.mean() <= blind.high:
        return YES
    return UNCLEAR if final.mean() > blind.value else NO


def profile(final: Array, returns: Array) -> Interval:
    """A performance profile (Agarwal et al. 2021): the shares of runs (n,) above returns (k,)."""
    above = (final > returns[:, None]).astype(float)
    return percentile(lambda values: values.mean(axis=-1), above)


def _components(encoders: Units, final: Array) -> dict[str, Interval]:
    counts = {len(runs) for runs in encoders}
    known = len(encoders) > 1 and len(counts) == 1 and counts != {1}
    found = components(final[np.array(encoders)]) if known else (UNDEFINED,) * 3
    return dict(zip(COMPONENTS, found, strict=True))


def components(returns: Array) -> tuple[Interval, Interval, Interval]:
    """How much of the spread of returns (e, r), at least two each, is of e encoders and r runs.

    The return of a run is a mean plus what its encoder adds plus what the run adds, each with a
    variance of its own: the one-way random effects model (Searle, Casella and McCulloch 1992,
    "Variance Components"). The estimates are those of the analysis of variance, cut off at 0.
    Intervals assume normal distributions: that of the runs' variance is of chi-squared, the ratio's
    is exact (section 3.6 there), and the encoders' is the one of Ting et al. 1990, "Confidence
    intervals on linear combinations of variance components that are unrestricted in sign", Journal
    of Statistical Computation and Simulation 35. As variances aren't negative, none ends below 0.

    Returns:
        The variance of what encoders add, that of what runs add, and the ratio of both.
    """
    encoders, runs = returns.shape
    freedom = encoders - 1, encoders * (runs - 1)
    between = runs * float(returns.mean(axis=1).var(ddof=1))
    within = float(returns.var(axis=1, ddof=1).mean())
    of_runs = Interval(
        within, *(within * freedom[1] / chi2.ppf(tail, freedom[1]) for tail in _TAILS)
    )
    quotient = between / within if within else np.inf if between else np.nan
    ratios = (quotient / f.ppf(tail, *freedom) for tail in _TAILS)
    ratio = (max((each - 1) / runs, 0.0) for each in (quotient, *ratios))
    below, above = _half_widths(between, within, freedom)
    difference = between - within
    ends = (difference, difference - below, difference + above)
    of_encoders = (max(end / runs, 0.0) for end in ends)
    return Interval(*of_encoders), of_runs, Interval(*ratio)


def _half_widths(between: float, within: float, freedom: tuple[int, int]) -> tuple[float, float]:
    """Of the interval of a difference of mean squares: to below and to above."""
    high, low = _TAILS
    g1, g2 = (1 - n / chi2.ppf(high, n) for n in freedom)
    h1, h2 = (n / chi2.ppf(low, n) - 1 for n in freedom)
    f_high, f_low = f.ppf(high, *freedom), f.ppf(low, *freedom)
    g12 = ((f_high - 1) ** 2 - (g1 * f_high) ** 2 - h2**2) / f_high
    h12 = ((1 - f_low) ** 2 - (h1 * f_low) ** 2 - g2**2) / f_low
    product = between * within
    return (
        float(np.sqrt(max((g1 * between) ** 2 + (h2 * within) ** 2 + g12 * product, 0))),
        float(np.sqrt(max((h1 * between) ** 2 + (g2 * within) ** 2 + h12 * product, 0))),
    )


def of_units(values: Array, encoders: Units) -> Array:
    """Numbers of runs, (n,), or their means by encoder, where there are enough."""
    if len(encoders) < FEWEST_UNITS:
        return values
    return np.array([values[runs].mean() for runs in encoders])


def _mean(values: Array, encoders: Units, bounds: Bounds) -> Interval:
    values = of_units(values, encoders)
    return unless_few(mean_within(values, bounds, LEVEL), len(values))


def _numbers(by_run: Mapping[str, Array], encoders: Units, bounds: Bounds) -> dict[str, Interval]:
    numbers = {}
    for name in ("final_return", "mean_return"):
        values = by_run[name]
        numbers[f"{name}_mean"] = _mean(values, encoders, bounds)
        numbers[f"{name}_median"] = percentile(_median, values)
        numbers[f"{name}_iqm"] = percentile(iqm, values)
    for name in ("gain", "score", "rise"):
        numbers[name] = _mean(by_run[name], encoders, Bounds())
    final = by_run["final_return"]
    numbers["final_return_sd"] = deviation(final)
    numbers["final_return_iqr"] = percentile(lambda v: iqr(v, axis=-1), final)
    numbers["final_return_mad"] = percentile(lambda v: median_abs_deviation(v, axis=-1), final)
    numbers["risk_across_runs"] = percentile(expected_shortfall, final)
    for name in STEPS_TO:
        numbers[name] = percentile(_median, by_run[name])
        numbers[REACHED[name]] = _share_reached(by_run[name])
    return numbers


def expected_shortfall(values: Array, tail: float = _TAIL) -> Array:
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


def _share_reached(steps: Array) -> Interval:
    """The share of runs (n,) that reached a return, with Wilson's interval (Wilson 1927)."""
    if np.isnan(steps).any():
        return UNDEFINED
    reached = int(np.isfinite(steps).sum())
    ends = binomtest(reached, len(steps)).proportion_ci(LEVEL, method="wilson")
    return unless_few(Interval(reached / len(steps), ends.low, ends.high), len(steps))
