"""Whether cohorts learn as stable-baselines3 does: python tools/trainers.py RESULTS.

RESULTS has returns.csv and runs.json of each study of studies/trainers in a folder of its own. The
verdicts go by the rule in results/trainers/README.md.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import norm, permutation_test, ttest_ind

from jbrep.errors import InputError
from jbrep.records.document import read_document
from jbrep.records.storage import write_whole
from jbrep.records.tables import read_rows
from jbrep.rl.files import FINISHED
from jbrep.stats import RunCurve
from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import variance_ratio
from jbrep.study.record import RECORD, RunsRecord
from jbrep.study.tables import RETURNS, Return, by_run
from jbrep.text import rounded, table

SB3, *COHORTS = ARMS = ("sb3", "float32", "bfloat16")
LEARNERS = ("sac", "ddpg")
WIDE, NARROW = 100, 50  # points of return
SURE, USUAL = 0.99, 0.90  # of intervals: to call arms different, and to call them equal
POWER = 0.8
PERMUTATIONS = 9999
HEADER = (
    "cohort, measure",
    "mean",
    "of sb3",
    "difference, 90 %",
    "99 %",
    "ratio of variances, 99 %",
    "p",
)
SUMMARY = "summary.txt"


class Compared(NamedTuple):
    """A measure of the runs of a cohort, against those of stable-baselines3."""

    mean: float
    of_sb3: float
    difference: Interval  # of means, at the level that calls them equal
    surely: Interval  # the same at the level that calls them different
    ratio: Interval  # of variances
    p: float  # of equal variances
    enough: int  # runs on either side that find the means, if they are the same, equal

    @classmethod
    def of(cls, x: Array, y: Array) -> "Compared":
        """Of the runs of a cohort (n,) and those of stable-baselines3 (m,)."""
        of_means = difference(x, y, USUAL), difference(x, y, SURE)
        ratio, p = variance_ratio(x, y, SURE), variance_p(x, y)
        return cls(x.mean(), y.mean(), *of_means, ratio, p, runs_to_decide(x, y))

    @property
    def differs(self) -> bool:
        """Whether means or variances differ, at the level for that."""
        of_means = self.surely.low > 0 or self.surely.high < 0
        of_variances = self.ratio.low > 1 or self.ratio.high < 1
        return of_means or (of_variances and self.p < 1 - SURE)

    def is_within(self, margin: float) -> bool:
        """Whether the means differ by less, as the test of equivalence has it."""
        return -margin < self.difference.low and self.difference.high < margin

    @property
    def cells(self) -> tuple[str, ...]:
        """Below HEADER, from its second name on."""
        low, high = rounded(self.ratio.low, self.ratio.high)
        return (
            *(f"{mean:.0f}" for mean in (self.mean, self.of_sb3)),
            f"{self.difference.value:.0f} [{self.difference.low:.0f}, {self.difference.high:.0f}]",
            f"[{self.surely.low:.0f}, {self.surely.high:.0f}]",
            f"{self.ratio.value:.2f} [{low}, {high}]",
            f"{self.p:.3f}",
        )


def verdict(measures: Mapping[str, Compared]) -> str:
    """By the rule that was written down before the first run."""
    if any(each.differs for each in measures.values()):
        return "different"
    for margin in (NARROW, WIDE):
        if all(each.is_within(margin) for each in measures.values()):
            return f"equal, within {margin} points"
    enough = max(each.enough for each in measures.values())
    return (
        f"undecided; {POWER:.0%} power to find equal means equal takes {enough} runs on either side"
    )


def runs_to_decide(x: Array, y: Array) -> int:
    """Runs on either side that find means, if they are the same, equal within WIDE with POWER.

    From the normal approximation of two one-sided tests with the deviations seen.
    """
    quantiles = norm.ppf((1 + USUAL) / 2) + norm.ppf((1 + POWER) / 2)
    return int(np.ceil((x.var(ddof=1) + y.var(ddof=1)) * (quantiles / WIDE) ** 2))


def difference(x: Array, y: Array, level: float) -> Interval:
    """The mean of x (n,) minus that of y (m,), with Welch's interval."""
    found = ttest_ind(x, y, equal_var=False).confidence_interval(level)
    return Interval(x.mean() - y.mean(), found.low, found.high)


def variance_p(x: Array, y: Array) -> float:
    """P-value of equal variances: a permutation test of the log of their ratio, two-sided.

    Runs are permuted after subtracting their group's median. Subtracting the mean instead, the
    test rejects 10 % of skewed returns with equal variances at a level of 5 %, and 36 % of returns
    of which a fifth are near 0.
    """

    def log_ratio(x: Array, y: Array, axis: int) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.abs(np.log(x.var(axis=axis, ddof=1)) - np.log(y.var(axis=axis, ddof=1)))

    result = permutation_test(
        (x - np.median(x), y - np.median(y)),
        log_ratio,
        permutation_type="independent",
        vectorized=True,
        n_resamples=PERMUTATIONS,
        alternative="greater",
        rng=np.random.default_rng(0),
    )
    return float(result.pvalue)


def read_arm(folder: Path, arm: str) -> list[RunCurve]:
    """The runs of a study, with the arm in the place of what they observe.

    Raises:
        InputError: a run failed, for which the plan has no rule.
    """
    record = read_document(folder / RECORD, RunsRecord)
    if failed := [run.seed for run in record.runs if run.status != FINISHED]:
        raise InputError(f"{folder}: the runs of the seeds {failed} failed")
    rows = read_rows(folder / RETURNS, Return, record.tables[RETURNS])
    return [
        RunCurve(
            task=rows[0].task,
            algorithm=rows[0].algorithm,
            representation=arm,
            seed=seed,
            settings="",
            steps=np.array([*by_step]),
            returns=np.array([*by_step.values()]),
            total_steps=max(by_step),
            return_floor=0,
            solved=900,
        )
        for (_, seed), by_step in by_run(rows).items()
    ]


def measured(runs: list[RunCurve]) -> dict[str, Array]:
    """Of each run, the mean return of its last evaluation, and of all."""
    means = np.array([run.returns.mean(1) for run in runs])
    return {"final return": means[:, -1], "mean return": means.mean(1)}


def main(results: Path) -> None:
    texts = []
    for learner in LEARNERS:
        arms = {arm: read_arm(results / f"{learner}-{arm}", arm) for arm in ARMS}
        usual, rows, verdicts = measured(arms[SB3]), [], []
        for arm in COHORTS:
            its = measured(arms[arm])
            compared = {name: Compared.of(its[name], usual[name]) for name in usual}
            rows += [(f"{arm}, {name}", *each.cells) for name, each in compared.items()]
            verdicts.append(f"{arm}: {verdict(compared)}")
        counts = ", ".join(f"{len(each)} of {arm}" for arm, each in arms.items())
        texts.append("\n".join((f"{learner}: runs, {counts}", table(HEADER, rows), *verdicts)))
    text = "\n\n".join(texts) + "\n"
    print(text, end="")
    write_whole(results / SUMMARY, text.encode())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
