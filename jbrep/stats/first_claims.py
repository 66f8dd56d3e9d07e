"""The claims of the first release, and what decides them: an interval and a boundary.

Results of that time keep these verdicts. Those of today are in `jbrep.stats.rules`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr
from scipy.stats import permutation_test

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.curves import compared, mean_return
from jbrep.stats.intervals import LEVEL, constant, difference, variance_ratio, welch
from jbrep.stats.means import Bounds, mean_within
from jbrep.stats.runs import Group
from jbrep.stats.scale import reference_of
from jbrep.stats.verdict import (
    CONTRADICTED,
    SUPPORTED,
    UNDECIDED,
    Key,
    Statement,
    Verdict,
    Verdicts,
)

MARGIN = 0.05  # of the baseline's gain over the reference: a smaller loss counts as similar
_ERROR = 0.05  # the probability that any of a study's verdicts is wrong
_PERMUTATIONS = 9999
_WORDS = {1: SUPPORTED, -1: CONTRADICTED, 0: UNDECIDED}


class Claim(NamedTuple):
    """A claim that a representation's runs, x, support or contradict against the baseline's, y.

    Args:
        name: in two words.
        statement: the claim as a sentence.
        quantity: what the interval is of, in words.
        measure: what is compared, a value for each run.
        interval: from x (..., n), y (..., m) and a level, (...).
        boundary: what the interval must exclude, from y and the reference, (...).
        side: 1 if an interval above the boundary supports the claim, -1 if one below does.
        p_value: two-sided, of lying on the boundary, from x (n,), y (m,), the boundary and a seed.
        allow_failures: whether the claim may be supported where runs of the representation failed.
        allow_no_learning: whether it may be supported where they learned nothing.
    """

    name: str
    statement: str
    quantity: str
    measure: str
    interval: Callable[[Array, Array, float], Interval]
    boundary: Callable[[Array, float], Array]
    side: int
    p_value: Callable[[Array, Array, float, int], float]
    allow_failures: bool
    allow_no_learning: bool


def decide(claim: Claim, interval: Interval, boundary: Array) -> Array:
    """1 where the claim is supported, -1 where contradicted, 0 where undecided; (...)."""
    above = np.asarray(interval.low) > boundary
    below = np.asarray(interval.high) < boundary
    return claim.side * (above.astype(int) - below.astype(int))


def mean_p(x: Array, y: Array, boundary: float = 0, seed: int = 0) -> float:
    """P-value of means of x (n,) and y (m,) differing by the boundary: Welch's two-sided test."""
    value, error, freedom = welch(x, y)
    return float(2 * stdtr(freedom, -np.abs(value - boundary) / error))


def variance_p(x: Array, y: Array, boundary: float = 1, seed: int = 0) -> float:
    """P-value of a ratio of variances at the boundary: a permutation test of its log, two-sided.

    Runs are permuted after subtracting their group's median. Subtracting the mean instead, the
    test rejects 10 % of skewed returns with equal variances at a level of 5 %, and 36 % of returns
    of which a fifth are near 0. With the median it rejected, for 5, 10 and 20 runs per group:
    normal 0.7, 3.5 and 4.7 %, skewed 0.9, 5.6 and 4.1 %, heavy tails 0.6, 4.1 and 5.4 %, a fifth
    near 0 1.2, 5.5 and 4.4 % (1,000 samples each). So with five runs it hardly ever rejects.
    """
    if constant(x) or constant(y):
        return np.nan
    centred = (x - np.median(x)) / np.sqrt(boundary), y - np.median(y)
    result = permutation_test(
        centred,
        _log_ratio,
        permutation_type="independent",
        vectorized=True,
        n_resamples=_PERMUTATIONS,
        alternative="greater",
        rng=np.random.default_rng(seed),
    )
    return float(result.pvalue)


def _log_ratio(x: Array, y: Array, axis: int) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(np.log(x.var(axis=axis, ddof=1)) - np.log(y.var(axis=axis, ddof=1)))


def _margin(y: Array, reference: float) -> Array:
    """A share of the gain of y (..., m): returns may be negative, a gain isn't."""
    return -MARGIN * np.maximum(y.mean(axis=-1) - reference, 0)


def _zero(y: Array, reference: float) -> Array:
    return np.zeros(y.shape[:-1])


def _one(y: Array, reference: float) -> Array:
    return np.ones(y.shape[:-1])


# runs that failed or learned nothing vary little, and runs that stay at a high return have a high
# mean return: neither may count in favour of a representation
SIMILAR_REWARD = Claim(
    name="similar reward",
    statement="The reduced state ends at a similar reward",
    quantity="difference of mean final returns",
    measure="final_return",
    interval=difference,
    boundary=_margin,
    side=1,
    p_value=mean_p,
    allow_failures=True,
    allow_no_learning=True,
)
LESS_VARIANCE = Claim(
    name="less variance",
    statement="It has less variance over training runs",
    quantity="ratio of variances of final returns",
    measure="final_return",
    interval=variance_ratio,
    boundary=_one,
    side=-1,
    p_value=variance_p,
    allow_failures=False,
    allow_no_learning=False,
)
FASTER_LEARNING = Claim(
    name="faster learning",
    statement="It learns faster",
    quantity="difference of mean returns over training",
    measure="mean_return",
    interval=difference,
    boundary=_zero,
    side=1,
    p_value=mean_p,
    allow_failures=True,
    allow_no_learning=False,
)
CLAIMS = (SIMILAR_REWARD, LESS_VARIANCE, FASTER_LEARNING)


def simultaneous_level(family: int) -> float:
    """The level of each of `family` intervals that hold together at 95 % (Bonferroni)."""
    return 1 - _ERROR / max(family, 1)


class _Arm(NamedTuple):
    """The runs of a representation."""

    name: str
    by_run: Mapping[str, Array]  # what claims measure
    learned: bool  # the final return lies above the untrained policy's, beyond chance
    failed: bool  # any run


@dataclass(frozen=True)
class FirstClaims:
    """Verdicts of the first release: all as strict as a study's number of comparisons asks.

    Args:
        planned: comparisons with the baseline in the whole study. If only a part of its runs is
            given, the verdicts are still as strict as those of the whole.
    """

    planned: int = 0

    @property
    def claims(self) -> tuple[Statement, ...]:
        """What is claimed."""
        return tuple(
            Statement(each.name, each.statement, each.quantity, each.interval is variance_ratio)
            for each in CLAIMS
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """How verdicts are reached, in sentences."""
        return (
            "Claims of the first release: verdicts by intervals that hold together at 95 % "
            f"(Bonferroni); similar is a loss of up to {100 * MARGIN:.0f} % of the gain.",
        )

    def __call__(self, groups: Mapping[Key, Group], seed: int = 0) -> Verdicts:
        """As for `Judge`."""
        there = sum(len(group) - 1 for group in groups.values())
        level = simultaneous_level(len(CLAIMS) * max(self.planned, there))
        return {key: _judged(group, level, seed) for key, group in groups.items()}


def _judged(group: Group, level: float, seed: int) -> dict[str, tuple[Verdict, ...]]:
    (first, *_), *_ = group.values()
    grid, _, curves, finals = compared(group)
    reference = reference_of(first, next(iter(curves.values())))
    baseline, *others = (
        _Arm(
            name,
            {"final_return": finals[name], "mean_return": mean_return(curves[name], grid)},
            _has_learned(finals[name] - curves[name][:, 0]),
            any(run.failed_at is not None for run in runs),
        )
        for name, runs in group.items()
    )
    return {
        each.name: tuple(
            _verdict(claim, each, baseline, reference, level, seed) for claim in CLAIMS
        )
        for each in others
    }


def _has_learned(gains: Array) -> bool:
    gain = mean_within(gains, Bounds(), LEVEL)
    return bool(gain.value > 0 and not gain.low <= 0)  # low is NaN where nothing varies


def _verdict(
    claim: Claim, arm: _Arm, baseline: _Arm, reference: float, level: float, seed: int
) -> Verdict:
    """A verdict by the interval of that level, and only where the p-value agrees.

    If one run in ten fails to learn, Bonett's interval decides between equal variances in 19 % of
    comparisons of 10 runs at a level of 0.56 %, the permutation test in 0.3 %.
    """
    x, y = arm.by_run[claim.measure], baseline.by_run[claim.measure]
    boundary = claim.boundary(y, reference)
    interval = claim.interval(x, y, level)
    decided = int(decide(claim, interval, boundary))
    p = claim.p_value(x, y, float(boundary), seed)
    reason = _reason(claim, x, y)
    if not baseline.learned:  # then there is nothing to compare with
        decided, reason = 0, f"{baseline.name} didn't learn"
    elif decided > 0 and arm.failed and not claim.allow_failures:
        decided, reason = 0, "failed runs"
    elif decided > 0 and not arm.learned and not claim.allow_no_learning:
        decided, reason = 0, f"{arm.name} didn't learn"
    elif decided and p > 1 - level:
        decided, reason = 0, "its p-value disagrees"
    return Verdict(
        claim=claim.name,
        verdict=_WORDS[decided],
        estimate=claim.interval(x, y, LEVEL),
        boundary=float(boundary),
        p=p,
        level=1 - level,
        interval=interval,
        runs=(len(x), len(y)),
        encoders=0,
        look=1,
        reason=reason,
    )


def _reason(claim: Claim, x: Array, y: Array) -> str | None:
    if not np.isnan(claim.interval(x, y, LEVEL).low):
        return None
    return "no variance" if constant(x) or constant(y) else "too few runs"
