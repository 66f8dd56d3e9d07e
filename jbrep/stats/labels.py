"""What the runs of one label returned, each by itself and together."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest, iqr, median_abs_deviation

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.curves import bands, final_return, iqm, mean_return, on_grid, steps_to
from jbrep.stats.intervals import LEVEL, UNDEFINED, deviation, mean, percentile
from jbrep.stats.reliability import TAIL_OF_RUNS, expected_shortfall, fixed_policy, within_runs
from jbrep.stats.runs import RunCurve

SOLVED = 900.0  # a final return that counts as a task solved
PROFILE_RETURNS = np.linspace(0, 1000, 51)  # at which a performance profile is drawn
SHARES = {"50_percent": 0.5, "90_percent": 0.9}  # of the baseline's median final return
STEPS_TO = tuple(f"steps_to_{name}" for name in (*SHARES, "900"))
WITHIN = (  # of one run
    "dispersion_across_time",
    "short_term_risk",
    "long_term_risk",
    "largest_drawdown",
    "policy_dispersion",
    "policy_risk",
)


@dataclass(frozen=True, eq=False)
class RepresentationResult:
    """The runs of one representation, with one task and algorithm.

    Args:
        representation: what the agent observed.
        settings: that all runs share.
        seeds: of the runs, in ascending order.
        failed: seeds of the runs that failed.
        curve: over the grid, (g,) each: percentiles over runs, mean, interquartile mean.
        by_run: numbers of each run, (runs,) each, in the order of seeds.
        numbers: numbers of the label, each with its 95 % interval.
        profile: the share of runs whose final return is above each of PROFILE_RETURNS, (51,).
    """

    representation: str
    settings: str
    seeds: tuple[int, ...]
    failed: tuple[int, ...]
    curve: Mapping[str, Array | Interval]
    by_run: Mapping[str, Array]
    numbers: Mapping[str, Interval]
    profile: Interval

    @property
    def learned(self) -> bool:
        """Whether the final return lies above the untrained policy's, beyond chance."""
        gain = self.numbers["gain"]
        return bool(gain.value > 0 and not gain.low <= 0)  # without an end where nothing varies


def thresholds(baseline: list[RunCurve], grid: Array) -> dict[str, float]:
    """The returns to reach, by the baseline's median final return; their names are STEPS_TO."""
    median = float(np.median(final_return(_curves(baseline, grid), grid)))
    returns = (*(share * median for share in SHARES.values()), SOLVED)
    return dict(zip(STEPS_TO, returns, strict=True))


def describe(
    runs: list[RunCurve], grid: Array, reach: Mapping[str, float], seed: int
) -> RepresentationResult:
    """A label's numbers.

    Args:
        runs: all of the label, in the order of seeds.
        grid: steps at which runs are compared, (g,).
        reach: the return to reach under each name of a number of steps.
        seed: of the resamples.
    """
    curves = _curves(runs, grid)
    failed = np.array([run.failed_at is not None for run in runs])
    by_run = {
        "final_return": final_return(curves, grid),
        "mean_return": mean_return(curves, grid),
        "gain": final_return(curves, grid) - curves[:, 0],
        **{name: steps_to(curves, grid, threshold) for name, threshold in reach.items()},
        **within_runs(curves, failed),
        **fixed_policy(runs, grid[-1]),
    }
    return RepresentationResult(
        representation=runs[0].representation,
        settings=runs[0].settings,
        seeds=tuple(int(run.seed) for run in runs),
        failed=tuple(int(run.seed) for run in runs if run.failed_at is not None),
        curve=bands(curves, seed),
        by_run=by_run,
        numbers=_numbers(by_run, seed),
        profile=profile(by_run["final_return"], seed),
    )


def profile(final_return: Array, seed: int) -> Interval:
    """A performance profile (Agarwal et al. 2021): shares of runs (n,) above PROFILE_RETURNS."""
    above = (final_return > PROFILE_RETURNS[:, None]).astype(float)
    return percentile(lambda values: values.mean(axis=-1), above, seed=seed)


def _curves(runs: list[RunCurve], grid: Array) -> Array:
    return np.stack([on_grid(run, grid) for run in runs])


def _numbers(by_run: Mapping[str, Array], seed: int) -> dict[str, Interval]:
    found = {}
    for name in ("final_return", "mean_return"):
        values = by_run[name]
        found[f"{name}_mean"] = mean(values)
        found[f"{name}_median"] = percentile(median, values, seed=seed)
        found[f"{name}_iqm"] = percentile(iqm, values, seed=seed)
    found["gain"] = mean(by_run["gain"])
    final = by_run["final_return"]
    found["final_return_sd"] = deviation(final)
    found["final_return_iqr"] = percentile(lambda v: iqr(v, axis=-1), final, seed=seed)
    found["final_return_mad"] = percentile(
        lambda v: median_abs_deviation(v, axis=-1), final, seed=seed
    )
    found["risk_across_runs"] = percentile(
        lambda v: expected_shortfall(v, TAIL_OF_RUNS), final, seed=seed
    )
    for name in STEPS_TO:
        found[name] = percentile(median, by_run[name], seed=seed)
        found[name.replace("steps_to", "reached")] = _share_reached(by_run[name])
    for name in WITHIN:
        finished = by_run[name][~np.isnan(by_run[name])]
        found[name] = percentile(median, finished, seed=seed) if len(finished) else UNDEFINED
    return found


def median(values: Array) -> Array:
    """Over runs, (..., n), of which some may be infinite."""
    return np.median(values, axis=-1)


def _share_reached(steps: Array) -> Interval:
    """The share of runs (n,) that reached a return, with Wilson's interval (Wilson 1927)."""
    if np.isnan(steps).any():
        return UNDEFINED
    reached = int(np.isfinite(steps).sum())
    found = binomtest(reached, len(steps)).proportion_ci(LEVEL, method="wilson")
    return Interval(reached / len(steps), found.low, found.high)
