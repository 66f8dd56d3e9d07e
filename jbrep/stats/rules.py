"""Verdicts on claims, by rules that are fixed before the first run.

Within a cell (a task, an algorithm and a representation) claims are tested one after the other,
each once the one before it is supported. The cells begin with equal shares of the level; one that
is done passes its share on to the others (Holm 1979; with orders within cells, Bretz et al. 2009,
"A graphical approach to sequentially rejective multiple test procedures", Statistics in Medicine
28). At each look of the study, tests take their part of that level (O'Brien and Fleming 1979, "A
multiple testing procedure for clinical trials", Biometrics 35): at the look with a share t of all
runs, a statistic that is standard normal if there is no effect decides beyond C / sqrt(t). The
constant C is found by integrating over the paths that haven't decided yet, as in Armitage,
McPherson and Rowe 1969, "Repeated significance tests on accumulating data".
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from scipy.integrate import simpson
from scipy.optimize import brentq
from scipy.stats import binomtest, norm

from jbrep.encoders import FULL
from jbrep.errors import InputError
from jbrep.records.record import Record
from jbrep.stats.arms import FEWEST_UNITS, Sides, learns, measure
from jbrep.stats.claims import (
    CLAIMS,
    CONTRADICTED,
    EXPLORATORY,
    NOT_WORSE,
    NOT_YET,
    SUPPORTED,
    UNDECIDED,
    Claim,
    Verdict,
    Verdicts,
)
from jbrep.stats.intervals import LEVEL, UNDEFINED, unless_few
from jbrep.stats.runs import Group, Key
from jbrep.stats.scale import CONSTANT, RANDOM, STILL, best_blind

_USUAL_LOOKS = (0.5, 1.0)
_Share = Annotated[float, Meta(gt=0, lt=1)]
_OVER = {  # which of them gains are counted over, by the words of a study
    "drives": (STILL, CONSTANT, RANDOM),
    "blind": (STILL, RANDOM),
    "still": (STILL,),
}
_POINTS = 401  # of the grid on which paths are integrated, with Simpson's rule


class Rules(Record, frozen=True, kw_only=True, omit_defaults=True):
    """What is tested, and how strictly: the table `verdicts` of a study's file.

    Raises:
        InputError: a field is out of its range, or they contradict one another.
    """

    primary: Annotated[
        tuple[str, ...],
        Meta(description="The cells that get verdicts, TASK/ALGORITHM/REPRESENTATION each."),
    ] = ()
    claims: Annotated[
        tuple[str, ...], Meta(description="In the order in which they are tested.")
    ] = tuple(CLAIMS)
    baseline: Annotated[
        str,
        Meta(
            description="The representation that the others are compared with; where no agent sees "
            "it, the first."
        ),
    ] = FULL
    error: Annotated[
        _Share,
        Meta(description="The probability that any of the verdicts is wrong, two-sided."),
    ] = 0.05
    margin: Annotated[
        _Share, Meta(description='The share of the gain that "not worse" may lose.')
    ] = 0.1
    failing: Annotated[
        _Share,
        Meta(description="The share of runs that may fail to learn in what is supported, at most."),
    ] = 0.2
    looks: Annotated[
        tuple[float, ...],
        Meta(
            description="Shares of the seeds after which there may be verdicts, ascending to 1; by "
            "default half of them and all, or all alone where half are too few for a verdict."
        ),
    ] = ()
    gains_over: Annotated[
        Literal["drives", "blind", "still"],
        Meta(
            description="What gains are counted over: the best of standing still, a constant drive "
            "and random actions (drives), the best of these without the constant drive (blind), or "
            "standing still."
        ),
    ] = "drives"

    def check(self) -> None:
        """Check what no field can say alone."""
        if len({*self.primary}) < len(self.primary):
            raise InputError(f"primary is {list(self.primary)}: each cell may be there once")
        looks = (0.0, *self.looks)
        if looks[-1] not in (0, 1) or not all(a < b for a, b in pairwise(looks)):
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

    @property
    def share(self) -> float:
        """The level of a cell before any is decided."""
        return self.error / max(1, len(self.primary))

    @property
    def compared_with(self) -> str:
        """What the agents that others are compared with see, in words."""
        return "the full state" if self.baseline == FULL else self.baseline

    @property
    def nothing_learnt(self) -> str:
        """Why there is no verdict where these agents don't learn."""
        return f"agents on {self.compared_with} didn't clearly learn"

    def baseline_of(self, names: Iterable[str]) -> str:
        """The representation that others are compared with, of some in the order of tables."""
        every = [*names]
        return self.baseline if self.baseline in every else every[0]

    @property
    def counted_over(self) -> tuple[str, ...]:
        """The policies over the best of which gains are counted."""
        return _OVER[self.gains_over]

    def reference(self, returns: Mapping[str, float]) -> str | None:
        """The policy that gains are counted over, of those whose returns are known."""
        known = {name: value for name, value in returns.items() if name in self.counted_over}
        return best_blind(known)


@dataclass(frozen=True)
class Planned:
    """Verdicts by rules on the runs that were planned; others are exploratory."""

    rules: Rules = field(default_factory=Rules)  # of the study
    seeds: tuple[int, ...] = ()  # of the planned runs, in their order
    # why there can be no verdict on some tasks, by name
    prevented: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def looks(self) -> tuple[float, ...]:
        """Shares of the seeds after which there may be verdicts."""
        if self.rules.looks:
            return self.rules.looks
        half = _USUAL_LOOKS[0] * len(self.seeds)
        return _USUAL_LOOKS if half >= FEWEST_UNITS else (1.0,)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """How many seeds there are at each look."""
        return tuple(map(self._count, self.looks))

    @cached_property
    def shares(self) -> tuple[float, ...]:
        """What the counts are of all seeds."""
        return tuple(count / len(self.seeds) for count in self.counts)

    def _count(self, share: float) -> int:
        return math.ceil(share * len(self.seeds) - 1e-9)

    def __call__(self, groups: Mapping[Key, Group], seed: int = 0) -> Verdicts:
        """What is found of each claim, for each representation but the first of each group.

        Raises:
            InputError: runs of a group have no range of steps in common.
        """
        cells = {name: _Cell(name, self.rules.share) for name in self.rules.primary}
        for look in range(len(self.looks)):
            _look(list(cells.values()), groups, self, look, seed)
        return {
            key: {
                name: _whole(cells.get(_cell_name(key, name)), group, name, self, seed)
                for name in list(group)[1:]
            }
            for key, group in groups.items()
        }


@dataclass
class _Cell:
    """A primary cell while it is tested, whether or not it has runs."""

    name: str
    level: float  # its share
    verdicts: list[Verdict] = field(default_factory=list)  # of claims that are decided
    undecided: Verdict | None = None  # of the claim that was tested last
    is_open: bool = True


def _cell_name(key: Key, representation: str) -> str:
    return "/".join((*key, representation))


def _look(
    cells: Sequence[_Cell], groups: Mapping[Key, Group], planned: Planned, look: int, seed: int
) -> None:
    """Test at a look whatever can be tested; levels that become free are used at once."""
    rules, seeds = planned.rules, planned.seeds[: planned.counts[look]]
    ready = {
        _cell_name(key, name): _sides(group, name, seeds)
        for key, group in groups.items()
        for name in list(group)[1:]
        if key[0] not in planned.prevented and _has_all(group, name, seeds)
    }
    tested = True
    while tested:
        tested = False
        for cell in cells:
            if not cell.is_open or cell.name not in ready:
                continue
            claim = CLAIMS[rules.claims[len(cell.verdicts)]]
            level = levels(planned.shares, cell.level)[look]
            verdict = _tested(claim, ready[cell.name], planned, level, look + 1, seed)
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


def _has_all(group: Group, name: str, seeds: Sequence[int]) -> bool:
    """Whether a representation and the baseline have all runs of the seeds."""
    both = (group[name], next(iter(group.values())))
    return bool(seeds) and all({run.seed for run in runs}.issuperset(seeds) for runs in both)


def _sides(group: Group, name: str, seeds: Collection[int]) -> Sides:
    """A representation against the baseline, with the runs of some seeds."""
    baseline = next(iter(group))
    frame, arms = measure({each: group[each] for each in (baseline, name)}, seeds)
    return Sides(arms[name], arms[baseline], frame)


def _tested(
    claim: Claim, sides: Sides, planned: Planned, level: float, look: int, seed: int
) -> Verdict:
    estimated = _estimated(claim, sides, planned.rules, seed)
    if estimated.reason:  # a share of no gain is no number to judge
        return replace(estimated, verdict=UNDECIDED, level=level, look=look)
    boundary = estimated.boundary
    p = claim.p_value(sides, boundary, seed)
    direction = claim.side * np.sign(estimated.estimate.value - boundary) if p <= level else 0
    reason = _reason(claim, sides, planned.rules, direction, level)
    if reason is None and np.isnan(p):
        reason = "nothing varies from run to run"
    if (reason or not direction) and look < len(planned.counts):
        later = f"another look comes at {planned.counts[look]} runs"
        reason = f"{reason}; {later}" if reason else later
    return replace(
        estimated,
        verdict={1: SUPPORTED, -1: CONTRADICTED, 0: UNDECIDED}[0 if reason else int(direction)],
        p=p,
        level=level,
        interval=claim.tested(sides, 1 - level, seed),
        look=look,
        reason=reason,
    )


def _reason(claim: Claim, sides: Sides, rules: Rules, direction: int, level: float) -> str | None:
    """Why there can't be a verdict; None if there can."""
    x, y, _ = sides
    fewest, what = min(x.units, y.units), "encoders" if x.by_encoder else "runs"
    if fewest < FEWEST_UNITS:
        return f"{fewest} {what}; verdicts take {FEWEST_UNITS}"
    if claim.limits_failures and direction > 0:
        most = most_failing(x.units - x.learnt, x.units, level)
        if most > rules.failing:
            return (
                f"up to {100 * most:.0f} % of its {what} may fail to learn; the limit is "
                f"{100 * rules.failing:.0f} %"
            )
    return None


def most_failing(failing: int, runs: int, level: float) -> float:
    """The exact upper bound on the share of runs that fail (Clopper and Pearson 1934).

    The level is that of the test that rests on it, so that they err together no more often.
    """
    test = binomtest(failing, runs, alternative="less")
    return float(test.proportion_ci(1 - level, method="exact").high)


def _estimated(claim: Claim, sides: Sides, rules: Rules, seed: int) -> Verdict:
    """An estimate without a verdict."""
    x, y, frame = sides
    compares = learns(y, frame)
    estimate = claim.estimate(sides, LEVEL, seed) if compares else UNDEFINED
    estimate = unless_few(estimate, x.units, y.units)
    return Verdict(
        claim=claim.name,
        verdict=EXPLORATORY,
        estimate=estimate,
        boundary=claim.boundary(rules.margin),
        p=np.nan,
        level=np.nan,
        interval=UNDEFINED._replace(value=estimate.value),
        runs=(x.runs, y.runs),
        encoders=x.units if x.by_encoder else 0,
        look=0,
        reason=None if compares else rules.nothing_learnt,
    )


def _explored(
    group: Group, name: str, rules: Rules, seeds: Collection[int], seed: int, tested: int = 0
) -> tuple[Verdict, ...]:
    """Estimates from runs of some seeds, of each claim but the first, which are tested."""
    sides = _sides(group, name, seeds)
    return tuple(_estimated(CLAIMS[each], sides, rules, seed) for each in rules.claims[tested:])


def _whole(
    cell: _Cell | None, group: Group, name: str, planned: Planned, seed: int
) -> tuple[Verdict, ...]:
    """A verdict on each claim: decided, tested last, or not tested; estimates of other cells."""
    rules, every = planned.rules, {run.seed for runs in group.values() for run in runs}
    if cell is None:
        return _explored(group, name, rules, every, seed)
    tested = (*cell.verdicts, *([cell.undecided] if cell.undecided else []))
    if not tested:
        first_look = f"the first look is at {planned.counts[0]} runs of each arm"
        task = next(iter(group.values()))[0].task
        reason = planned.prevented.get(task, first_look)
        return tuple(
            replace(each, verdict=NOT_YET, estimate=UNDEFINED, interval=UNDEFINED, reason=reason)
            for each in _explored(group, name, rules, every, seed)
        )
    before = tested[-1]
    seeds = planned.seeds[: planned.counts[before.look - 1]]
    reason = f"not tested: {before.claim!r} is {before.verdict}"
    return (
        *tested,
        *(
            replace(each, verdict=UNDECIDED, look=before.look, reason=reason)
            for each in _explored(group, name, rules, seeds, seed, len(tested))
        ),
    )


@lru_cache(256)
def levels(shares: Sequence[float], level: float) -> tuple[float, ...]:
    """The two-sided level of the test at each look, from shares of the runs that ascend to 1.

    All looks together have the level that is given, two-sided, too.

    Raises:
        InputError: looks that are too close to each other, or to the first run.
    """
    if len(shares) == 1:
        return (level,)
    least = norm.isf(level / 2)
    try:
        constant = brentq(lambda c: _decided(shares, c) - level, least - 0.1, 2 * least + 2)
    except ValueError:
        told = ", ".join(f"{share:g}" for share in shares)
        raise InputError(
            f"no levels can be computed for looks at {told} of the runs and an error of {level:g}: "
            "plan fewer looks, further apart, or an error near 0.05"
        ) from None
    return tuple(2 * norm.sf(constant / np.sqrt(shares)).astype(float))


def _decided(shares: Sequence[float], constant: float) -> float:
    """The probability that one of the looks decides if there is no effect."""
    score, weight, before, undecided = np.zeros(1), np.ones(1), 0.0, 1.0
    every = np.eye(_POINTS)  # of which the integrals are the weights of the points
    for share in shares:  # a score with variance t, which decides beyond C
        spread = np.sqrt(share - before)
        grid = np.linspace(-constant, constant, _POINTS)
        density = norm.pdf(grid[:, None], score, spread) @ weight
        stays = norm.cdf(constant, score, spread) - norm.cdf(-constant, score, spread)
        undecided = float(weight @ stays)
        score, weight, before = grid, density * simpson(every, dx=grid[1] - grid[0], axis=0), share
    return 1 - undecided
