"""A representation's runs against the baseline's: numbers, and verdicts on the claims."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import levene

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.first_claims import CLAIMS, VERDICTS, Claim, decide
from jbrep.stats.intervals import FEWEST, LEVEL, constant, difference, percentile, variance_ratio
from jbrep.stats.labels import RepresentationResult, check_names, check_numbers, median
from jbrep.stats.power import seeds_needed
from jbrep.stats.scale import STEPS_TO

COMPARISON_NUMBERS = (
    "final_return_difference",
    "mean_return_difference",
    "variance_ratio",
    "variance_ratio_bootstrap",
    "probability_of_improvement",
    *(f"{name}_ratio" for name in STEPS_TO),
)
_ERROR = 0.05  # the probability that any of a study's verdicts is wrong


def simultaneous_level(family: int) -> float:
    """The level of each of `family` intervals that hold together at 95 % (Bonferroni)."""
    return 1 - _ERROR / max(family, 1)


@dataclass(frozen=True)
class Verdict:
    """The verdict of the runs on a claim.

    Args:
        claim: its name.
        verdict: supported, contradicted or undecided, by the simultaneous interval, and only where
            the p-value agrees: if one run in ten fails to learn, Bonett's interval decides between
            equal variances in 19 % of comparisons of 10 runs at a level of 0.56 %, the permutation
            test in 0.3 %.
        boundary: the value that the interval must exclude.
        nominal: the quantity that the claim is about, with its 95 % interval.
        simultaneous: the same with an interval of the level that all verdicts of the study share.
        p: two-sided, of lying on the boundary; NaN where it is undefined.
        p_holm: adjusted for all verdicts of the study.
        seeds_needed: runs per representation that would decide an undecided claim, or "> 320";
            None if it is decided or has a reason.
        reason: why it is undecided, if not because the interval is too wide.

    Raises:
        ValueError: an unknown verdict, or several intervals in place of one.
    """

    claim: str
    verdict: str
    boundary: float
    nominal: Interval
    simultaneous: Interval
    p: float
    p_holm: float
    seeds_needed: int | str | None
    reason: str | None

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS.values():
            raise ValueError(f"unknown verdict {self.verdict!r}")
        if np.ndim(self.nominal.value) or np.ndim(self.simultaneous.value):
            raise ValueError("nominal and simultaneous must be one interval each")


@dataclass(frozen=True, eq=False)
class Comparison:
    """A representation against the baseline.

    Args:
        representation: its name.
        numbers: COMPARISON_NUMBERS, each with its 95 % interval.
        brown_forsythe_p: of equal variances of final returns, as a check of the permutation test;
            NaN where it is undefined.
        verdicts: one for each of CLAIMS, in that order.

    Raises:
        ValueError: numbers or verdicts that are missing or unknown.
    """

    representation: str
    numbers: Mapping[str, Interval]
    brown_forsythe_p: float
    verdicts: tuple[Verdict, ...]

    def __post_init__(self) -> None:
        check_numbers(self.numbers, COMPARISON_NUMBERS)
        check_names("claims", [v.claim for v in self.verdicts], [claim.name for claim in CLAIMS])

    def verdict(self, claim: Claim) -> Verdict:
        """The verdict on a claim."""
        return next(verdict for verdict in self.verdicts if verdict.claim == claim.name)


def compare(
    label: RepresentationResult,
    baseline: RepresentationResult,
    reference: float,
    family: int,
    seed: int,
) -> Comparison:
    """A representation against the baseline; the p-values of its verdicts aren't adjusted yet.

    Args:
        label: of the representation.
        baseline: of the same task and algorithm.
        reference: the return that gains are counted from.
        family: the number of verdicts in the study.
        seed: of all resampling.
    """
    final, final_of_baseline = label.by_run["final_return"], baseline.by_run["final_return"]
    numbers = {
        "final_return_difference": difference(final, final_of_baseline),
        "mean_return_difference": difference(
            label.by_run["mean_return"], baseline.by_run["mean_return"]
        ),
        "variance_ratio": variance_ratio(final, final_of_baseline),
        "variance_ratio_bootstrap": percentile(
            _ratio_of_variances, final, final_of_baseline, seed=seed
        ),
        "probability_of_improvement": percentile(
            probability_of_improvement, final, final_of_baseline, seed=seed
        ),
    }
    for name in STEPS_TO:
        numbers[f"{name}_ratio"] = percentile(
            _ratio_of_medians, label.by_run[name], baseline.by_run[name], seed=seed
        )
    return Comparison(
        representation=label.representation,
        numbers=numbers,
        brown_forsythe_p=_brown_forsythe(final, final_of_baseline),
        verdicts=tuple(_judge(claim, label, baseline, reference, family, seed) for claim in CLAIMS),
    )


def probability_of_improvement(x: Array, y: Array) -> Array:
    """The share of pairs in which a run of x (..., n) beats one of y (..., m); ties count half.

    Mann and Whitney's statistic, as in Agarwal et al. 2021, "Deep Reinforcement Learning at the
    Edge of the Statistical Precipice".
    """
    return (1 + np.sign(x[..., :, None] - y[..., None, :]).mean(axis=(-2, -1))) / 2


def _ratio_of_variances(x: Array, y: Array) -> Array:
    return x.var(axis=-1, ddof=1) / y.var(axis=-1, ddof=1)


def _ratio_of_medians(x: Array, y: Array) -> Array:
    return median(x) / median(y)


def _brown_forsythe(x: Array, y: Array) -> float:
    if constant(x) or constant(y) or min(len(x), len(y)) < FEWEST:
        return np.nan
    return float(levene(x, y, center="median").pvalue)


def _judge(
    claim: Claim,
    label: RepresentationResult,
    baseline: RepresentationResult,
    reference: float,
    family: int,
    seed: int,
) -> Verdict:
    x, y = label.by_run[claim.measure], baseline.by_run[claim.measure]
    level = simultaneous_level(family)
    boundary = claim.boundary(y, reference)
    simultaneous = claim.interval(x, y, level)
    decided = int(decide(claim, simultaneous, boundary))
    p = claim.p_value(x, y, float(boundary), seed)
    reason = _reason(claim, x, y)
    if not baseline.learned:  # then there is nothing to compare with
        decided, reason = 0, f"{baseline.representation} didn't learn"
    elif decided > 0 and label.failed and not claim.allow_failures:
        decided, reason = 0, "failed runs"
    elif decided > 0 and not label.learned and not claim.allow_no_learning:
        decided, reason = 0, f"{label.representation} didn't learn"
    elif decided and p > 1 - level:
        decided, reason = 0, "its p-value disagrees"
    needed = None if decided or reason else seeds_needed(claim, x, y, reference, level, seed)
    return Verdict(
        claim=claim.name,
        verdict=VERDICTS[decided],
        boundary=float(boundary),
        nominal=claim.interval(x, y, LEVEL),
        simultaneous=simultaneous,
        p=p,
        p_holm=p,
        seeds_needed=needed,
        reason=reason,
    )


def _reason(claim: Claim, x: Array, y: Array) -> str | None:
    if not np.isnan(claim.interval(x, y, LEVEL).low):
        return None
    return "no variance" if constant(x) or constant(y) else "too few runs"


def adjusted(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """The comparisons with the p-values of all their verdicts adjusted together."""
    p = np.array([verdict.p for c in comparisons for verdict in c.verdicts])
    p_holm = iter(holm(p).tolist())
    return [
        replace(c, verdicts=tuple(replace(v, p_holm=next(p_holm)) for v in c.verdicts))
        for c in comparisons
    ]


def holm(p: Array) -> Array:
    """P-values (k,) adjusted for their number (Holm 1979); NaN counts as 1 and stays NaN."""
    counted = np.where(np.isnan(p), 1, p)
    order = np.argsort(counted, kind="stable")
    factors = np.arange(len(p), 0, -1)
    p_holm = np.empty(len(p))
    p_holm[order] = np.minimum(np.maximum.accumulate(factors * counted[order]), 1)
    return np.where(np.isnan(p), np.nan, p_holm)
