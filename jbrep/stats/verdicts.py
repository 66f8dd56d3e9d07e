"""Verdicts on claims, by rules that are fixed before the first run.

Within a cell (a task, an algorithm and a representation) claims are tested one after the other,
each once the one before it is supported. The cells begin with equal shares of the level; one that
is done passes its share on to the others (Holm 1979; with orders within cells, Bretz et al. 2009,
"A graphical approach to sequentially rejective multiple test procedures", Statistics in Medicine
28). At each look of the study, tests take their part of that level (`jbrep.stats.looks`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest

from jbrep.errors import InputError
from jbrep.stats.arms import FEWEST, Arm, Frame, learns, measure
from jbrep.stats.bootstrap import Interval
from jbrep.stats.claims import CLAIMS, NOT_WORSE, Claim
from jbrep.stats.looks import levels
from jbrep.stats.runs import Group

ERROR = 0.05  # the probability that any of a study's verdicts is wrong, two-sided
LEVEL = 0.95  # of intervals that are shown
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
NOT_YET, EXPLORATORY = "not yet", "exploratory"
VERDICTS = (SUPPORTED, CONTRADICTED, UNDECIDED, NOT_YET, EXPLORATORY)
_FEWEST_FOR_INTERVALS = 4  # with three runs or fewer, points are shown

Key = tuple[str, str]  # task and algorithm


@dataclass(frozen=True, kw_only=True)
class Rules:
    """What is tested, and how strictly.

    Args:
        primary: the cells that get verdicts, TASK/ALGORITHM/REPRESENTATION each.
        seeds: of the planned runs, in their order.
        claims: names, in the order in which they are tested.
        margin: the share of the gain that "not worse" may lose.
        failing: the share of runs that may fail to learn where it is supported, at most.
        looks: shares of the seeds after which there may be verdicts, ascending to 1.

    Raises:
        InputError: they contradict one another.
    """

    primary: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    claims: tuple[str, ...] = tuple(CLAIMS)
    margin: float = 0.1
    failing: float = 0.2
    looks: tuple[float, ...] = (0.5, 1.0)

    def __post_init__(self) -> None:
        for name in ("margin", "failing"):
            if not 0 < getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}: it must be between 0 and 1")
        looks = (0.0, *self.looks)
        if self.looks[-1:] != (1,) or any(a >= b for a, b in pairwise(looks)):
            raise InputError(
                f"looks are {list(self.looks)}: they must be shares of the seeds that ascend to 1"
            )
        if unknown := [name for name in self.claims if name not in CLAIMS]:
            raise InputError(f"unknown claim {unknown[0]!r}: choose of {', '.join(CLAIMS)}")
        if self.claims[:1] != (NOT_WORSE.name,) or len({*self.claims}) < len(self.claims):
            raise InputError(
                f"claims are {list(self.claims)}: each may be there once, and {NOT_WORSE.name!r} "
                "comes first, as agents that learn nothing vary little"
            )

    def seeds_at(self, look: int) -> tuple[int, ...]:
        """The seeds whose runs count at a look."""
        return self.seeds[: math.ceil(self.looks[look] * len(self.seeds) - 1e-9)]


@dataclass(frozen=True)
class Verdict:
    """What is found of a claim in a cell.

    Args:
        claim: its name.
        verdict: one of VERDICTS.
        estimate: with its 95 % interval; without one for three runs or fewer.
        boundary: that the estimate is held against.
        p: two-sided, of lying on the boundary; NaN where there is none.
        level: of the last test, two-sided; NaN if there was none.
        interval: of that level.
        runs: of the representation and of the baseline that count.
        look: how many looks had come when it was decided or last tested; 0 if none.
        reason: why it is not decided, if not because the estimate is too rough.

    Raises:
        ValueError: an unknown verdict.
    """

    claim: str
    verdict: str
    estimate: Interval
    boundary: float
    p: float
    level: float
    interval: Interval
    runs: tuple[int, int]
    look: int
    reason: str | None

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"unknown verdict {self.verdict!r}")


@dataclass
class _Cell:
    """A primary cell while it is tested."""

    key: Key
    representation: str
    level: float  # its share
    verdicts: list[Verdict] = field(default_factory=list)  # of claims that are decided
    undecided: Verdict | None = None  # of the claim that was tested last
    is_open: bool = True

    @property
    def name(self) -> str:
        return "/".join((*self.key, self.representation))


def judge(
    groups: Mapping[Key, Group], rules: Rules, seed: int = 0
) -> dict[Key, dict[str, tuple[Verdict, ...]]]:
    """What is found of each claim, for each representation but the first of each group.

    Args:
        groups: runs by task and algorithm, then by representation, the baseline first.
        rules: of the study.
        seed: of all resampling.

    Raises:
        InputError: runs of a group have no range of steps in common.
    """
    found = {
        key: {name: _explored(group, name, rules, seed) for name in list(group)[1:]}
        for key, group in groups.items()
    }
    cells = [
        _Cell(key, name, ERROR / len(rules.primary))
        for key, group in groups.items()
        for name in list(group)[1:]
        if "/".join((*key, name)) in rules.primary
    ]
    for look in range(len(rules.looks)):
        _look(cells, groups, rules, look, seed)
    for cell in cells:
        shown = found[cell.key][cell.representation]
        found[cell.key][cell.representation] = _whole(cell, shown)
    return found


def _look(
    cells: Sequence[_Cell],
    groups: Mapping[Key, Group],
    rules: Rules,
    look: int,
    seed: int,
) -> None:
    """Test at a look whatever can be tested; levels that become free are used at once."""
    seeds = rules.seeds_at(look)
    ready = {c.name: m for c in cells if (m := _measured(groups[c.key], c.representation, seeds))}
    tested = True
    while tested:
        tested = False
        for cell in cells:
            if not cell.is_open or cell.name not in ready:
                continue
            claim = CLAIMS[rules.claims[len(cell.verdicts)]]
            level = levels(rules.looks, cell.level)[look]
            verdict = _tested(claim, *ready[cell.name], rules, level, look + 1, seed)
            if verdict.verdict == UNDECIDED:
                cell.undecided = verdict
                continue
            cell.verdicts.append(verdict)
            cell.undecided, tested = None, True
            if verdict.verdict == CONTRADICTED or len(cell.verdicts) == len(rules.claims):
                cell.is_open = False
                _pass_on(cell, cells)


def _pass_on(done: _Cell, cells: Sequence[_Cell]) -> None:
    others = [cell for cell in cells if cell.is_open]
    for cell in others:
        cell.level += done.level / len(others)


def _measured(
    group: Group, representation: str, seeds: Sequence[int]
) -> tuple[Arm, Arm, Frame] | None:
    """The arms of a representation and of the baseline, if all runs of the seeds are there."""
    baseline = next(iter(group))
    both = {name: group[name] for name in (baseline, representation)}
    if not all({run.seed for run in runs}.issuperset(seeds) for runs in both.values()):
        return None
    frame, arms = measure(both, seeds)
    return arms[representation], arms[baseline], frame


def _tested(
    claim: Claim,
    x: Arm,
    y: Arm,
    frame: Frame,
    rules: Rules,
    level: float,
    look: int,
    seed: int,
) -> Verdict:
    boundary = claim.boundary(rules.margin)
    verdict = _estimated(claim, x, y, frame, boundary, seed)
    p = claim.p_value(x, y, frame, boundary, seed)
    direction = claim.side * np.sign(verdict.estimate.value - boundary) if p <= level else 0
    reason = _reason(claim, x, y, frame, rules, direction)
    word = {1: SUPPORTED, -1: CONTRADICTED, 0: UNDECIDED}[0 if reason else int(direction)]
    return Verdict(
        claim=claim.name,
        verdict=word,
        estimate=verdict.estimate,
        boundary=boundary,
        p=p,
        level=level,
        interval=claim.estimate(x, y, frame, 1 - level, seed),
        runs=(x.runs, y.runs),
        look=look,
        reason=reason,
    )


def _reason(claim: Claim, x: Arm, y: Arm, frame: Frame, rules: Rules, direction: int) -> str | None:
    """Why there can't be a verdict; None if there can."""
    fewest = min(x.units, y.units)
    if fewest < FEWEST:
        what = "encoders" if x.by_encoder else "runs"
        return f"{fewest} {what}; verdicts take {FEWEST}"
    if not learns(y, frame):
        return "agents on the full state didn't learn"
    if claim is NOT_WORSE and direction > 0:
        most = most_failing(x.runs - x.learnt, x.runs)
        if most > rules.failing:
            return (
                f"up to {100 * most:.0f} % of its runs may fail to learn; the limit is "
                f"{100 * rules.failing:.0f} %"
            )
    return None


def most_failing(failing: int, runs: int) -> float:
    """The exact upper bound (Clopper and Pearson 1934) at 95 % on the share of runs that fail."""
    test = binomtest(failing, runs, alternative="less")
    return float(test.proportion_ci(LEVEL, method="exact").high)


def _estimated(claim: Claim, x: Arm, y: Arm, frame: Frame, boundary: float, seed: int) -> Verdict:
    """An estimate without a verdict."""
    estimate = claim.estimate(x, y, frame, LEVEL, seed)
    if min(x.units, y.units) < _FEWEST_FOR_INTERVALS:
        estimate = Interval(estimate.value, np.nan, np.nan)
    return Verdict(
        claim=claim.name,
        verdict=EXPLORATORY,
        estimate=estimate,
        boundary=boundary,
        p=np.nan,
        level=np.nan,
        interval=Interval(estimate.value, np.nan, np.nan),
        runs=(x.runs, y.runs),
        look=0,
        reason=None,
    )


def _explored(group: Group, name: str, rules: Rules, seed: int) -> tuple[Verdict, ...]:
    """Estimates of each claim from all runs."""
    baseline = next(iter(group))
    both = {each: group[each] for each in (baseline, name)}
    frame, arms = measure(both, {run.seed for runs in both.values() for run in runs})
    return tuple(
        _estimated(
            CLAIMS[claim],
            arms[name],
            arms[baseline],
            frame,
            CLAIMS[claim].boundary(rules.margin),
            seed,
        )
        for claim in rules.claims
    )


def _whole(cell: _Cell, explored: tuple[Verdict, ...]) -> tuple[Verdict, ...]:
    """A verdict on each claim: decided, tested last, or not tested."""
    tested = (*cell.verdicts, *([cell.undecided] if cell.undecided else []))
    others = explored[len(tested) :]
    if not tested:
        nothing = Interval(np.nan, np.nan, np.nan)
        return tuple(
            replace(each, verdict=NOT_YET, estimate=nothing, interval=nothing) for each in others
        )
    before = tested[-1]
    reason = f"not tested: {before.claim!r} is {before.verdict}"
    return (
        *tested,
        *(replace(each, verdict=UNDECIDED, look=before.look, reason=reason) for each in others),
    )
