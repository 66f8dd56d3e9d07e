"""Verdicts on claims, by rules that are fixed before the first run.

The claims on two representations of a task and algorithm are tested one after the other, each once
the one before it is supported. Such chains begin with equal shares of the error; one that is done
passes its share on to the others (Holm 1979; with orders within chains, Bretz et al. 2009, "A
graphical approach to sequentially rejective multiple test procedures", Statistics in Medicine 28).
There is one look: when all planned runs of both sides have ended.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from scipy.stats import binomtest

from jbrep.encoders import FULL
from jbrep.errors import InputError
from jbrep.records.record import Record
from jbrep.stats.bootstrap import Interval
from jbrep.stats.claims import BETTER, CLAIMS, CONTRADICTED, NOT_WORSE, SUPPORTED, UNDECIDED, Claim
from jbrep.stats.intervals import LEVEL, UNDEFINED, unless_few
from jbrep.stats.pairs import FEWEST_UNITS, Pair, pair_of
from jbrep.stats.runs import LARGEST_RETURN, Group, Key
from jbrep.stats.scale import LOOKING

_FIRST = (BETTER.name, NOT_WORSE.name)  # agents that learn nothing vary little
_SENTENCE = re.compile(rf"(\S+) ({'|'.join(CLAIMS)})(?: than (\S+))?")
_Share = Annotated[float, Meta(gt=0, lt=1)]


class Stated(NamedTuple):
    """A claim of a study's file."""

    x: str
    claim: Claim
    y: str

    def __str__(self) -> str:
        return f"{self.x} {self.claim.name} than {self.y}"


class Rules(Record, frozen=True, kw_only=True, omit_defaults=True):
    """What is tested, and how strictly: the table `verdicts` of a study's file."""

    claims: Annotated[
        tuple[str, ...],
        Meta(
            description=f"Such as 'symmetry better than coordinates', for each task and algorithm: "
            f"{', '.join(CLAIMS)}; without 'than', of the baseline. Claims on the same two are "
            "tested in their order."
        ),
    ] = ()
    baseline: Annotated[
        str,
        Meta(
            description="The representation that tables compare the others with; where no agent "
            "sees it, the first."
        ),
    ] = FULL
    error: Annotated[
        _Share, Meta(description="The probability that any of the verdicts is wrong, two-sided.")
    ] = 0.05
    margin: Annotated[
        _Share, Meta(description="By how much of the score (0 to 1) 'not worse' may be lower.")
    ] = 0.1
    reference: Annotated[
        str | Annotated[float, Meta(ge=-LARGEST_RETURN, le=LARGEST_RETURN)],
        Meta(
            description="What scores 1, where the best blind baseline scores 0: a "
            "policy, as jbrep evaluate-policy takes it, or a return.",
            extra={"default": "the scripted policy"},
        ),
    ] = ""

    def check(self) -> None:
        """Check what no field can say alone."""
        for (x, y), chain in self.chains.items():
            names = [claim.name for claim in chain]
            if len({*names}) < len(names):
                raise InputError(f"claims has {names[-1]!r} of {x} than {y} twice")
            if names[0] not in _FIRST:
                raise InputError(
                    f"claims has {x} {names[0]} than {y} first: {' or '.join(map(repr, _FIRST))} "
                    f"of these two must come before, as agents that learn nothing vary little"
                )

    @property
    def stated(self) -> list[Stated]:
        """The claims."""
        return [self._read(each) for each in self.claims]

    def _read(self, text: str) -> Stated:
        found = _SENTENCE.fullmatch(" ".join(text.split()))
        if found is None or found[1] == (found[3] or self.baseline):
            raise InputError(
                f"claims has {text!r}: it must be as 'symmetry better than coordinates', with one "
                f"of {', '.join(CLAIMS)} between two representations"
            )
        return Stated(found[1], CLAIMS[found[2]], found[3] or self.baseline)

    @property
    def chains(self) -> dict[tuple[str, str], list[Claim]]:
        """The claims on each two representations, in the order of their tests."""
        found: dict[tuple[str, str], list[Claim]] = {}
        for x, claim, y in self.stated:
            found.setdefault((x, y), []).append(claim)
        return found

    @property
    def top(self) -> str | float:
        """What scores 1: the policy or the return that is named, or else the scripted one."""
        return LOOKING if self.reference == "" else self.reference

    @property
    def policy(self) -> str:
        """The policy that is named to score 1; empty for a return, and for the scripted one."""
        return self.reference if isinstance(self.reference, str) else ""

    def baseline_of(self, names: Iterable[str]) -> str:
        """The representation that others are compared with, of some in the order of tables."""
        every = [*names]
        return self.baseline if self.baseline in every else every[0]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What is found of a claim."""

    task: str
    algorithm: str
    x: str
    claim: str
    y: str
    verdict: str  # SUPPORTED, CONTRADICTED or UNDECIDED
    estimate: Interval = UNDEFINED  # with its 95 % interval; without one of three units or fewer
    boundary: float = np.nan  # that the estimate is held against
    p: float = np.nan  # two-sided, of lying on the boundary
    level: float = np.nan  # of the test, two-sided
    interval: Interval = UNDEFINED  # of 1 minus that level
    width: float = np.nan  # of the scale from 0 to 1, where the estimate is a difference of returns
    runs: int = 0  # on each side
    units: int = 0  # of the test
    by_encoder: bool = False  # whether these are encoders
    by: int | None = None  # the steps by which it is so, where a curve of either side still rises
    reason: str | None = None  # why it is not decided, if not because the estimate is too rough


@dataclass(frozen=True)
class Planned:
    """Verdicts by rules on the runs that were planned."""

    rules: Rules = field(default_factory=Rules)  # of the study
    seeds: tuple[int, ...] = ()  # of the planned runs; others are exploratory
    groups: tuple[Key, ...] = ()  # of the planned runs
    # why there can be no verdict on some tasks, by name
    prevented: Mapping[str, str] = field(default_factory=dict)

    @property
    def share(self) -> float:
        """The level at which each chain of claims begins."""
        return self.rules.error / max(1, len(self.rules.chains) * len(self.groups))

    def __call__(self, groups: Mapping[Key, Group]) -> list[Verdict]:
        """What is found of each claim, on each planned task and algorithm."""
        chains = [
            _Chain(key, x, y, claims, self._pair(key, group, x, y), self.share, self.rules.margin)
            for key in self.groups
            for group in [groups.get(key, {})]
            for (x, y), claims in self.rules.chains.items()
        ]
        waiting = chains
        while decided := [chain for chain in waiting if chain.test()]:
            waiting = [chain for chain in chains if not chain.is_done]
            for chain in decided:
                if chain.is_done:
                    for other in waiting:
                        other.level += chain.level / len(waiting)
        return [verdict for chain in chains for verdict in chain.every()]

    def _pair(self, key: Key, group: Group, x: str, y: str) -> Pair | str:
        if reason := self.prevented.get(key[0]):
            return reason
        for name in (x, y):
            ended = {run.seed for run in group.get(name, ())}.intersection(self.seeds)
            if not ended:  # those of one run, or beside fewer of the baseline, aren't compared
                return f"fewer than two runs on {name} or {self.rules.baseline} have ended"
            if len(ended) < len(self.seeds):
                return f"{len(ended)} of {len(self.seeds)} runs on {name} have ended"
        return pair_of(group, x, y, self.seeds) or "two runs on each side are needed"


@dataclass
class _Chain:
    key: Key
    x: str
    y: str
    claims: Sequence[Claim]
    pair: Pair | str  # a reason where there is none
    level: float
    margin: float  # of *not worse*
    decided: list[Verdict] = field(default_factory=list)
    undecided: Verdict | None = None  # of the claim that was tested last

    @property
    def is_done(self) -> bool:
        """Whether nothing is left to test."""
        contradicted = any(each.verdict == CONTRADICTED for each in self.decided)
        return contradicted or len(self.decided) == len(self.claims)

    def test(self) -> bool:
        """Test the claims that are left, one after the other; whether any was decided."""
        before = len(self.decided)
        while not (self.is_done or isinstance(self.pair, str)):
            claim = self.claims[len(self.decided)]
            verdict = _tested(self._estimated(claim, self.pair), claim, self)
            self.undecided = verdict if verdict.verdict == UNDECIDED else None
            if self.undecided:
                break
            self.decided.append(verdict)
        return len(self.decided) > before

    def every(self) -> Iterator[Verdict]:
        """A verdict on each claim: decided, tested last, or not tested."""
        yield from self.decided
        if self.undecided:
            yield self.undecided
        last = self.undecided or (self.decided[-1] if self.decided else None)
        for claim in self.claims[len(self.decided) + bool(self.undecided) :]:
            if isinstance(self.pair, str):
                yield Verdict(**self._about(claim), reason=self.pair)
            else:
                assert last
                reason = f"not tested: {last.claim!r} is {last.verdict}"
                yield replace(self._estimated(claim, self.pair), reason=reason)

    def _about(self, claim: Claim) -> dict[str, Any]:
        task, algorithm = self.key
        of = {"task": task, "algorithm": algorithm, "x": self.x, "claim": claim.name, "y": self.y}
        return {**of, "verdict": UNDECIDED}

    def _estimated(self, claim: Claim, pair: Pair) -> Verdict:
        learnt = pair.y_learns or not claim.takes_learning
        boundary = claim.boundary(pair, self.margin)
        reason = None if learnt else f"agents on {self.y} aren't above the blind baselines"
        if math.isnan(boundary):
            reason = "no reference policy is known that would score 1"
        estimate = UNDEFINED if reason else claim.estimate(pair, LEVEL)
        estimate = unless_few(estimate, pair.units)
        return Verdict(
            **self._about(claim),
            estimate=estimate,
            boundary=boundary,
            interval=UNDEFINED._replace(value=estimate.value),
            width=pair.ends.top - pair.ends.blind if claim.is_of_returns else np.nan,
            runs=pair.runs,
            units=pair.units,
            by_encoder=pair.by_encoder,
            by=round(pair.steps) if pair.rising else None,
            reason=reason,
        )


def _tested(estimated: Verdict, claim: Claim, chain: _Chain) -> Verdict:
    pair = chain.pair
    assert isinstance(pair, Pair)
    if estimated.reason:
        return estimated
    boundary, level = estimated.boundary, chain.level
    p = claim.p_value(pair, boundary)
    direction = int(claim.side * np.sign(estimated.estimate.value - boundary)) if p <= level else 0
    reason = "nothing varies from run to run" if np.isnan(p) else None
    if pair.units < FEWEST_UNITS:
        what = "encoders" if pair.by_encoder else "runs"
        reason = f"{pair.units} {what}; verdicts take {FEWEST_UNITS}"
    elif direction and claim.is_of_returns:
        reason = _may_fail(pair, estimated.estimate.value - boundary, level)
    return replace(
        estimated,
        verdict={1: SUPPORTED, -1: CONTRADICTED, 0: UNDECIDED}[0 if reason else direction],
        p=p,
        level=level,
        interval=(claim.tested or claim.estimate)(pair, 1 - level),
        reason=reason,
    )


def _may_fail(pair: Pair, excess: float, level: float) -> str | None:
    """Why a verdict wouldn't hold if as many units failed as can't be excluded; None if it would.

    Of eight units that all learn a third may fail, unseen, which no interval shows. So the side
    that ends higher than the boundary says has to stay so when that share of it returns no more
    than the best blind baseline.
    """
    side = pair.x if excess > 0 else pair.y
    failing, units = side.failing, len(side.final)
    more = most_failing(failing, units, level) - failing / units
    lost = more * max(float(np.median(side.final)) - pair.ends.blind, 0.0)
    if abs(excess) > lost:
        return None
    which = "it" if excess > 0 else "the other"
    share = 100 * (more + failing / units)
    return f"so few runs can't rule out that up to {share:.0f} % on {which} fail"


def most_failing(failing: int, units: int, level: float) -> float:
    """The exact upper bound on the share of units that fail (Clopper and Pearson 1934).

    The level is that of the test that rests on it, so that they err together no more often.
    """
    test = binomtest(failing, units, alternative="less")
    return float(test.proportion_ci(1 - level, method="exact").high)
