"""Statistics in words: what is claimed, how it is decided, what was found."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from jbrep.encoders import FULL
from jbrep.stats import Analysis
from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.bootstrap import Interval
from jbrep.stats.claims import (
    CLAIMS,
    FASTER,
    LESS_VARIANCE,
    NOT_WORSE,
    WITHIN_HALF,
    Verdict,
)
from jbrep.stats.comparison import Comparison
from jbrep.stats.rules import Planned, Rules
from jbrep.stats.scale import STILL
from jbrep.study.record import RegistrationFacts
from jbrep.text import SIGNIFICANT, number, possessive

EFFECTS = (  # of `jbrep.stats.power`
    f"Power of {NOT_WORSE.name!r} and {WITHIN_HALF.name!r}: if agents keep all of the gain, and "
    "final returns of runs have an SD of 5, 10 or 20 % of it, on either side. Of "
    f"{LESS_VARIANCE.name!r}: if the spread of curves is 1/2, 1/3 or 1/5 of the baseline's. Of "
    f"{FASTER.name!r}: if half of the gain comes earlier by a tenth of training, and the time "
    "varies by an SD of 5, 10 or 20 % of training. Each by itself: claims before it, and runs that "
    "fail to learn, may stop a verdict."
)
_LEAST_LACKING = 1e-12  # of 1, in a level: floating-point numbers tell no more of it
_KEPT = "gain over {over}, as a share of that on {baseline}"
_HEADS = {  # of columns
    NOT_WORSE.name: "of {whose} gain",
    LESS_VARIANCE.name: "spread of curves, times {whose}",
    FASTER.name: "steps to half of {whose} gain",
    WITHIN_HALF.name: "of {whose} gain",
}
_OVER = {
    "drives": "the best policy that doesn't look",
    "blind": "the better of standing still and random actions",
    "still": "standing still",
}
_CLAIMS = {  # as a sentence; what is estimated
    NOT_WORSE.name: ("{agents} lose at most {percent} of {gain}", _KEPT),
    LESS_VARIANCE.name: (
        "Their training varies less from run to run",
        "spread of training curves, as a multiple of that on {baseline}",
    ),
    FASTER.name: (
        "They learn faster",
        "steps to half of the gain on {baseline}, beside what agents there take",
    ),
    WITHIN_HALF.name: ("They lose at most {percent} of it", _KEPT),
}
_BESIDE = {  # a claim's verdict: what else is known of it
    NOT_WORSE.name: ("Difference of final returns", "final_return_difference"),
    LESS_VARIANCE.name: ("Ratio of variances of final returns", "variance_ratio"),
    FASTER.name: ("Ratio of median steps to half of the gain", "steps_to_50_percent_ratio"),
}


class Statement(NamedTuple):
    """A claim in words."""

    name: str
    head: str  # of a column of estimates
    statement: str  # as a sentence
    estimand: str  # what is estimated
    is_ratio: bool  # of which logarithms are drawn


class Finding(NamedTuple):
    """A verdict on one representation."""

    where: str  # task and algorithm
    representation: str
    verdict: str
    sentence: str


class Answer(NamedTuple):
    """All verdicts of a study on one claim."""

    claim: Statement
    headline: str
    counts: dict[str, int]  # of verdicts
    findings: list[Finding]


def over(rules: Rules) -> str:
    """What gains are counted over."""
    return _OVER[rules.gains_over]


def statements(planned: Planned) -> list[Statement]:
    """What is claimed, in the order of the tests."""
    found, rules = [], planned.rules
    is_full = rules.baseline == FULL
    words = {
        "baseline": rules.compared_with,
        "whose": possessive(rules.baseline),
        "over": over(rules),
        "agents": "Agents on less state" if is_full else "Agents",
        "gain": "the gain" if is_full else f"the gain on {rules.baseline}",
    }
    for name in rules.claims:
        claim = CLAIMS[name]
        words["percent"] = f"{100 * (1 - claim.boundary(rules.margin)):.3g} %"
        texts = (_HEADS[name], *_CLAIMS[name])
        head, statement, estimand = (each.format(**words) for each in texts)
        found.append(Statement(name, head, statement, estimand, claim.is_ratio))
    return found


def notes(planned: Planned) -> list[str]:
    """How verdicts are reached, in sentences."""
    cells = len(planned.rules.primary)
    if not cells:
        return [
            "No cell was named primary before the runs: all numbers are exploratory, and there are "
            "no verdicts."
        ]
    shared = "one primary cell has" if cells == 1 else f"{cells} primary cells share"
    counts = " and ".join(map(str, planned.counts))
    levels = ", at O'Brien and Fleming's levels" if len(planned.counts) > 1 else ""
    return [
        f"Claims are tested in the order {', '.join(planned.rules.claims)}, each once the one "
        f"before it is supported; {shared} an error of {100 * planned.rules.error:.3g} %, "
        "two-sided, in Holm's way.",
        f"Verdicts may come after {counts} runs of each arm{levels}; other cells are exploratory.",
    ]


def caveats(planned: Planned) -> list[str]:
    """Where verdicts are wrong more often than planned, in sentences."""
    margin, failing = planned.rules.margin, planned.rules.failing
    if failing <= margin:
        return []
    return [
        f"Where between {100 * margin:.3g} and {100 * failing:.3g} % of runs fail, "
        f"{NOT_WORSE.name!r} is wrongly supported more often than that (docs/verdicts.md): a "
        f"verdicts.failing of {margin:g} keeps to it, and takes more runs."
    ]


def _overall(counts: Counter[str]) -> str:
    """The verdict if all agree, otherwise how many there are of each."""
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{verdict} in {count}" for verdict, count in counts.most_common())


def answers(analysis: Analysis) -> list[Answer]:
    """Each claim, with every verdict on it."""
    return [_answer(i, claim, analysis) for i, claim in enumerate(statements(analysis.planned))]


def _answer(position: int, claim: Statement, analysis: Analysis) -> Answer:
    pairs = [(group, each) for group in analysis.groups for each in group.comparisons]
    findings = [
        Finding(
            group.name,
            each.representation,
            each.verdicts[position].verdict,
            _sentence(claim, each.verdicts[position], each.representation, analysis.baseline),
        )
        for group, each in pairs
    ]
    counts = Counter(each.verdicts[position].verdict for _, each in pairs)
    overall = _overall(counts) if counts else "no reduced state was compared"
    headline = f"{claim.statement}: {overall}"
    return Answer(claim, headline, dict(counts), findings)


def _sentence(claim: Statement, verdict: Verdict, name: str, baseline: str) -> str:
    """The numbers behind a verdict; of an undecided one, why."""
    found = remark(verdict)
    if not math.isnan(verdict.estimate.value):
        found = f"{claim.estimand} {found}"
    return f"{name} against {baseline}: {found or '-'}."


def tested(verdict: Verdict) -> str:
    """The estimate with the interval that decides, and where it lies; empty if none was tested."""
    _, low, high = verdict.interval
    if math.isnan(verdict.level) or math.isnan(low) or math.isnan(high):
        return ""
    return f"{deciding(verdict)}, which {_place(verdict)} {shown_number(verdict.boundary)}"


def deciding(verdict: Verdict) -> str:
    """The interval that decides, with its level: two digits at least of what it lacks of 100 %."""
    lacking = max(verdict.level, _LEAST_LACKING)
    digits = max(4, 1 - math.floor(math.log10(lacking)))
    level = f"{100 * (1 - lacking):.{digits}g} %"
    return f"{told(verdict.claim, verdict.interval)} at {level}"


def _place(verdict: Verdict) -> str:
    if verdict.interval.low > verdict.boundary:
        return "lies above"
    return "lies below" if verdict.interval.high < verdict.boundary else "contains"


def remark(verdict: Verdict) -> str:
    """The estimate with the interval that decides, or why there is no verdict."""
    known = "" if math.isnan(verdict.estimate.value) else told(verdict.claim, verdict.estimate)
    return "; ".join(filter(None, (tested(verdict) or known, verdict.reason)))


def told(claim: str, estimate: Interval) -> str:
    """The estimate of a claim, with its direction where a sign would have to be known."""
    if claim != FASTER.name or math.isnan(estimate.value):
        return shown(estimate)
    value, *ends = (_later(steps) for steps in estimate)
    return value if math.isnan(estimate.low) else f"{value} [{ends[0]}, {ends[1]}]"


def _later(steps: float) -> str:
    count = f"{abs(steps):,.0f}"
    return count if count == "0" else f"{count} {'slower' if steps > 0 else 'faster'}"


def enumerated(names: Sequence[str]) -> str:
    """Names in a sentence: a, b and c."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def details(
    claim: Statement,
    verdict: Verdict,
    comparison: Comparison,
    group: GroupAnalysis,
    registration: RegistrationFacts | None,
) -> list[tuple[str, str]]:
    """All that a verdict rests on, each with a heading."""
    rows = [
        ("Claim", claim.statement),
        ("Estimand", claim.estimand),
        ("Gains are counted over", reference_words(group)),
    ]
    if not math.isnan(verdict.estimate.value):
        rows.append(("Estimate with 95 % interval", told(verdict.claim, verdict.estimate)))
    rows.append(("Boundary", shown_number(verdict.boundary)))
    if not math.isnan(verdict.level):
        test = tested(verdict) or "no interval"
        levels = f"p {probability(verdict.p)} at a level of {probability(verdict.level)}"
        rows.append((f"Test at look {verdict.look}", f"{test}; {levels}"))
    if verdict.reason:
        rows.append(("Why", verdict.reason))
    if verdict.claim in _BESIDE and comparison.is_open:
        words, name = _BESIDE[verdict.claim]
        runs = "" if comparison.counts_all else f", of all {sum(comparison.runs)} runs"
        rows.append((f"{words}{runs}", shown(comparison.numbers[name])))
    runs = "{} of {} and {} of {}".format(
        *(verdict.runs[0], comparison.representation),
        *(verdict.runs[1], group.labels[0].representation),
    )
    rows += [("Runs", runs), ("It holds", scope(comparison, verdict, group))]
    return [*rows, ("Deviations", _deviations(registration))]


def scope(comparison: Comparison, verdict: Verdict, group: GroupAnalysis) -> str:
    """What encoders a verdict speaks of."""
    if verdict.encoders:
        return f"for encoders made like these {verdict.encoders}, which are the units of the test"
    (label,) = (each for each in group.labels if each.representation == comparison.representation)
    return "for this encoder" if label.encoders == 1 else f"for these {label.encoders} encoders"


def _deviations(registration: RegistrationFacts | None) -> str:
    if registration is None:
        return "not registered beforehand"
    return "; ".join(registration.deviations) or "none from what was registered"


def reference_words(group: GroupAnalysis) -> str:
    """What gains are counted over."""
    policy = group.reference_policy
    if policy and policy == group.best_policy != STILL:
        what = f"what the best policy that doesn't look returns ({policy})"
    elif policy:
        what = f"what {policy} returns"
    elif not math.isnan(group.return_floor):
        what = "the least possible return"
    else:
        what = "the mean return of untrained policies"
    return f"{what}, {shown_number(group.reference)}"


def shown(values: Interval, form: str = SIGNIFICANT) -> str:
    """A value with its interval, if it has one; a dash for a value that isn't finite."""
    value, *ends = map(float, values)
    if any(map(math.isnan, ends)):
        return shown_number(value, form)
    low, high = ("unbounded" if math.isinf(end) else shown_number(end, form) for end in ends)
    return f"{shown_number(value, form)} [{low}, {high}]"


def shown_number(value: float, form: str = SIGNIFICANT) -> str:
    """A number; a dash if it isn't finite."""
    return number(value if math.isfinite(value) else None, form)


def probability(p: float) -> str:
    """A probability to three digits; a dash where there is none."""
    if math.isnan(p):
        return "-"
    return "<0.001" if p < 0.001 else f"{p:.3f}"
