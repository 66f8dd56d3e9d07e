"""Verdicts in sentences."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from jbrep.stats import Analysis
from jbrep.stats.comparison import Comparison, Verdict
from jbrep.stats.first_claims import CLAIMS, Claim
from jbrep.stats.summary import shown, shown_number


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


def answers(analysis: Analysis) -> list[Answer]:
    """Each claim of the paper, with every verdict on it."""
    return [_answer(claim, analysis) for claim in CLAIMS]


def _answer(claim: Claim, analysis: Analysis) -> Answer:
    findings = list(_findings(claim, analysis))
    counts = Counter(finding.verdict for finding in findings)
    headline = f"{claim.statement}: {_overall(counts)}"
    return Answer(claim.name, headline, dict(counts), findings)


def _overall(counts: Counter[str]) -> str:
    """The verdict if all agree, otherwise how many there are of each."""
    if not counts:
        return "no reduced state was compared"
    if len(counts) == 1:
        (verdict,) = counts
        return verdict
    return ", ".join(f"{verdict} in {count}" for verdict, count in counts.most_common())


def _findings(claim: Claim, analysis: Analysis) -> Iterator[Finding]:
    for group in analysis.groups:
        for comparison in group.comparisons:
            verdict = comparison.verdict(claim).verdict
            sentence = _sentence(claim, comparison, analysis)
            yield Finding(group.name, comparison.representation, verdict, sentence)


def _sentence(claim: Claim, comparison: Comparison, analysis: Analysis) -> str:
    """The numbers behind a verdict; of an undecided one, why or what would decide it."""
    verdict = comparison.verdict(claim)
    pair = f"{comparison.representation} against {analysis.baseline}"
    sentence = f"{pair}: {claim.quantity} {shown(verdict.nominal)}"
    _, low, high = verdict.simultaneous
    if math.isfinite(low) and math.isfinite(high):
        level = f"{100 * analysis.simultaneous_level:.2f} %"
        bound = f"{claim.boundary_name} {shown_number(verdict.boundary)}".lstrip()
        ends = f"[{shown_number(low)}, {shown_number(high)}]"
        sentence += f"; at {level}, {ends} {_place(verdict)} {bound}"
    return f"{sentence}{_outlook(verdict)}."


def _place(verdict: Verdict) -> str:
    if verdict.simultaneous.low > verdict.boundary:
        return "lies above"
    return "lies below" if verdict.simultaneous.high < verdict.boundary else "contains"


def _outlook(verdict: Verdict) -> str:
    if verdict.reason:
        return f"; undecided: {verdict.reason}"
    if verdict.seeds_needed is None:
        return ""
    most = str(verdict.seeds_needed).removeprefix("> ")
    count = f"about {most}" if isinstance(verdict.seeds_needed, int) else f"more than {most}"
    return f"; {count} seeds would decide"


def remark(verdict: Verdict) -> str:
    """Why a verdict is undecided, or how many seeds would decide it, for a narrow column."""
    if verdict.seeds_needed is not None:
        return f"{verdict.seeds_needed} seeds"
    return verdict.reason or ""
