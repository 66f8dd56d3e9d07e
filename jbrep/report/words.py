"""What the statistics say, in sentences."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from jbrep.stats.claims import MARGIN
from jbrep.text import SIGNIFICANT, interval, number

Plain = Mapping[str, Any]  # statistics.json, or a part of it

_CLAIMS = {
    "similar reward": "The reduced state ends at a similar reward",
    "less variance": "It has less variance over training runs",
    "faster learning": "It learns faster",
}
_MEASURES = {
    "similar reward": "difference of mean final returns",
    "less variance": "ratio of variances of final returns",
    "faster learning": "difference of mean returns over training",
}

_BOUNDARIES = {
    "similar reward": f"the margin of {100 * MARGIN:.0f} %, ",
    "less variance": "",
    "faster learning": "",
}


class Finding(NamedTuple):
    """A verdict on one representation."""

    where: str  # task and algorithm
    representation: str
    verdict: str
    sentence: str


class Answer(NamedTuple):
    """What a study says of a claim."""

    claim: str
    headline: str
    counts: dict[str, int]  # of verdicts
    findings: list[Finding]


def answers(statistics: Plain) -> list[Answer]:
    """Each claim of the paper, with every verdict on it."""
    found = []
    for claim, words in _CLAIMS.items():
        findings = list(_findings(claim, statistics))
        counts = Counter(finding.verdict for finding in findings)
        headline = f"{words}: {_overall(counts)}"
        found.append(Answer(claim, headline, dict(counts), findings))
    return found


def _overall(counts: Counter[str]) -> str:
    """The verdict, if all agree; else how many say what."""
    if not counts:
        return "no reduced state was compared"
    if len(counts) == 1:
        (verdict,) = counts
        return verdict
    return ", ".join(f"{verdict} in {count}" for verdict, count in counts.most_common())


def _findings(claim: str, statistics: Plain) -> Iterator[Finding]:
    for group in statistics["groups"]:
        for comparison in group["comparisons"]:
            verdict = next(v for v in comparison["verdicts"] if v["claim"] == claim)
            yield Finding(
                f"{group['task']}, {group['algorithm']}",
                comparison["representation"],
                verdict["verdict"],
                _sentence(verdict, comparison["representation"], statistics),
            )


def _sentence(verdict: Plain, representation: str, statistics: Plain) -> str:
    """The numbers behind a verdict, and what would decide where nothing does."""
    nominal = interval(verdict["nominal"], SIGNIFICANT)
    _, *ends = verdict["simultaneous"]
    level = f"{100 * statistics['simultaneous_level']:.2f} %"
    pair = f"{representation} against {statistics['baseline']}"
    said = f"{pair}: {_MEASURES[verdict['claim']]} {nominal}"
    if None not in ends:
        low, high = (number(end, SIGNIFICANT) for end in ends)
        bound = _BOUNDARIES[verdict["claim"]] + number(verdict["boundary"], SIGNIFICANT)
        said += f"; at {level}, [{low}, {high}] {_place(verdict)} {bound}"
    if verdict["reason"]:
        return f"{said}; not decided: {verdict['reason']}."
    needed = verdict["seeds_needed"]
    if needed is None:
        return f"{said}."
    count = f"more than {needed[2:]}" if isinstance(needed, str) else f"about {needed}"
    return f"{said}; {count} seeds would decide."


def _place(verdict: Plain) -> str:
    _, low, high = verdict["simultaneous"]
    if low > verdict["boundary"]:
        return "lies above"
    return "lies below" if high < verdict["boundary"] else "contains"
