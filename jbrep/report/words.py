"""Verdicts in sentences."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from jbrep.report.tables import RegistrationRecord
from jbrep.stats import Analysis
from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.comparison import Comparison
from jbrep.stats.rules import NONE_PRIMARY
from jbrep.stats.summary import probability, reference_words, shown, shown_number
from jbrep.stats.verdict import EXPLORATORY, NOT_YET, Statement, Verdict

_BESIDE = {  # a claim's verdict: what else is known of it
    "not worse": ("Difference of final returns", "final_return_difference"),
    "less variance": ("Ratio of variances of final returns", "variance_ratio"),
    "faster": ("Ratio of median steps to half of the gain", "steps_to_50_percent_ratio"),
}


class Finding(NamedTuple):
    """A verdict on one representation."""

    where: str  # task and algorithm
    representation: str
    verdict: str
    sentence: str


class Answer(NamedTuple):
    """All verdicts of a study on one claim."""

    claim: str
    headline: str
    counts: dict[str, int]  # of verdicts
    findings: list[Finding]


def headline(analysis: Analysis | None) -> str:
    """What was found, in a sentence."""
    if analysis is None:
        return "There are no statistics yet, and so no verdicts."
    found = list(_all(analysis))
    if not found:
        return "No reduced state was compared with the full one."
    judged = [verdicts for verdicts in found if verdicts[0].verdict != EXPLORATORY]
    if not judged and NONE_PRIMARY in analysis.notes:
        return "There are no verdicts: no cell was named primary before the runs."
    if not judged:
        return "There are no verdicts yet: no primary cell has two runs of each side."
    decided = [verdicts for verdicts in judged if verdicts[0].verdict != NOT_YET]
    if not decided:
        return f"There are no verdicts yet: {judged[0][0].reason}."
    cells = "the one cell" if len(judged) == 1 else f"the {len(judged)} cells"
    columns = zip(analysis.claims, zip(*judged, strict=True), strict=True)
    parts = [f"{claim.name!r} {_overall(_counts(each))}" for claim, each in columns]
    return f"In {cells} judged: {'; '.join(parts)}."


def _all(analysis: Analysis) -> Iterator[tuple[Verdict, ...]]:
    return (each.verdicts for group in analysis.groups for each in group.comparisons)


def _counts(verdicts: Sequence[Verdict]) -> Counter[str]:
    return Counter(verdict.verdict for verdict in verdicts)


def _overall(counts: Counter[str]) -> str:
    """The verdict if all agree, otherwise how many there are of each."""
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{verdict} in {count}" for verdict, count in counts.most_common())


def answers(analysis: Analysis) -> list[Answer]:
    """Each claim, with every verdict on it."""
    return [_answer(number, claim, analysis) for number, claim in enumerate(analysis.claims)]


def _answer(number: int, claim: Statement, analysis: Analysis) -> Answer:
    pairs = [(group, each) for group in analysis.groups for each in group.comparisons]
    findings = [
        Finding(
            group.name,
            each.representation,
            each.verdicts[number].verdict,
            _sentence(claim, each.verdicts[number], each.representation, analysis.baseline),
        )
        for group, each in pairs
    ]
    counts = _counts([each.verdicts[number] for _, each in pairs])
    overall = _overall(counts) if counts else "no reduced state was compared"
    return Answer(claim.name, f"{claim.statement}: {overall}", dict(counts), findings)


def _sentence(claim: Statement, verdict: Verdict, name: str, baseline: str) -> str:
    """The numbers behind a verdict; of an undecided one, why."""
    parts = [f"{name} against {baseline}: {claim.estimand} {shown(verdict.estimate)}"]
    if test := _tested(verdict):
        parts.append(test)
    if verdict.reason:
        parts.append(verdict.reason)
    return f"{'; '.join(parts)}."


def _tested(verdict: Verdict) -> str:
    """Where the interval lies that decides; empty where nothing was tested."""
    _, low, high = verdict.interval
    if math.isnan(verdict.level) or math.isnan(low) or math.isnan(high):
        return ""
    ends = f"[{shown_number(low)}, {shown_number(high)}]"
    level, boundary = f"{100 * (1 - verdict.level):.4g} %", shown_number(verdict.boundary)
    return f"at {level}, {ends} {_place(verdict)} {boundary}"


def _place(verdict: Verdict) -> str:
    if verdict.interval.low > verdict.boundary:
        return "lies above"
    return "lies below" if verdict.interval.high < verdict.boundary else "contains"


def remark(verdict: Verdict) -> str:
    """The estimate, and why there is no verdict, for a narrow column."""
    estimate = "" if math.isnan(verdict.estimate.value) else shown(verdict.estimate)
    return "; ".join(filter(None, (estimate, verdict.reason)))


def details(
    claim: Statement,
    verdict: Verdict,
    comparison: Comparison,
    group: GroupAnalysis,
    registration: RegistrationRecord | None,
) -> list[tuple[str, str]]:
    """All that a verdict rests on, each with a heading."""
    rows = [
        ("Claim", claim.statement),
        ("Estimand", claim.estimand),
        ("Gains are counted from", reference_words(group)),
    ]
    if not math.isnan(verdict.estimate.value):
        rows.append(("Estimate with 95 % interval", shown(verdict.estimate)))
    rows.append(("Boundary", shown_number(verdict.boundary)))
    if not math.isnan(verdict.level):
        tested = _tested(verdict) or "no interval"
        levels = f"p {probability(verdict.p)} at a level of {probability(verdict.level)}"
        rows.append((f"Test at look {verdict.look}", f"{tested}; {levels}"))
    if verdict.reason:
        rows.append(("Why", verdict.reason))
    if verdict.claim in _BESIDE and comparison.is_open:
        words, number = _BESIDE[verdict.claim]
        rows.append((words, shown(comparison.numbers[number])))
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


def _deviations(registration: RegistrationRecord | None) -> str:
    if registration is None:
        return "not registered beforehand"
    return "; ".join(registration["deviations"]) or "none from what was registered"
