"""Statistics in words: what is claimed, how it is decided, what was found."""

import math
from collections.abc import Sequence

from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.bootstrap import Interval
from jbrep.stats.claims import CONTRADICTED, FASTER, SUPPORTED, UNDECIDED
from jbrep.stats.power import BETTER_BY, EARLIER_BY, SDS
from jbrep.stats.rules import Planned, Verdict
from jbrep.text import SIGNIFICANT, number

_SHOWN = ", ".join(f"{sd:g}" for sd in SDS)
EFFECTS = (  # of `jbrep.stats.power`
    f"Power: 'better' if the score is higher by {BETTER_BY:g}, 'not worse' if it is the same, and "
    f"differences of scores between units have an SD of {_SHOWN}; 'faster' if half of the gain "
    f"comes earlier by {EARLIER_BY:g} of training, with an SD of {_SHOWN} of it; 'less variable' "
    "if the spread of curves is 1/2, 1/3 or 1/5 of the other's. Each by itself, if no run fails. "
    "As many as 'unseen' may fail and none be seen to: a difference must hold even then."
)
_LEAST_LACKING = 1e-12  # of 1, in a level: floating-point numbers tell no more of it


def notes(planned: Planned) -> list[str]:
    """How verdicts are reached, in sentences."""
    if not planned.rules.claims:
        return ["No claim was registered before the runs: all numbers are exploratory."]
    count = len(planned.rules.chains) * len(planned.groups)
    share = "one comparison has" if count == 1 else f"{count} comparisons share"
    return [
        f"{share[0].upper()}{share[1:]} an error of {100 * planned.rules.error:.3g} %, two-sided, "
        "by Holm's procedure; claims on the same two representations are tested in their order, "
        "each once the one before it is supported. Runs are compared seed by seed, or encoder by "
        f"encoder where there are enough, when all {len(planned.seeds)} on both sides have ended."
    ]


def conclusion(verdicts: Sequence[Verdict]) -> str:
    """All verdicts in a sentence or two."""
    told = []
    for state in (SUPPORTED, CONTRADICTED, UNDECIDED):
        if of_state := [each for each in verdicts if each.verdict == state]:
            told.append(f"{state}: {', '.join(_where(each, verdicts) for each in of_state)}")
    text = "; ".join(told)
    return f"{text[0].upper()}{text[1:]}." if text else ""


def _where(verdict: Verdict, verdicts: Sequence[Verdict]) -> str:
    """A claim, with its task and algorithm where there are several, and until when it is so."""
    beside = []
    if len({each.task for each in verdicts}) > 1:
        beside.append(verdict.task)
    if len({each.algorithm for each in verdicts}) > 1:
        beside.append(verdict.algorithm)
    if by := _by(verdict):
        beside.append(by)
    return verdict.sentence + (f" ({', '.join(beside)})" if beside else "")


def _by(verdict: Verdict) -> str:
    """Until when it is so, of what is decided while a curve rises."""
    is_decided = verdict.verdict != UNDECIDED
    return f"by {verdict.by:,} steps" if verdict.by and is_decided else ""


def verdict_cells(verdict: Verdict) -> dict[str, str]:
    """What a verdict rests on, by the heads of columns."""
    interval = verdict.estimate if math.isnan(verdict.level) else verdict.interval
    score = Interval(*(end / verdict.width for end in interval))
    return {
        "claim": verdict.sentence,
        "verdict": " ".join(filter(None, (verdict.verdict, _by(verdict)))),
        "estimate": told(verdict.claim, interval),
        "score": shown(score, ".2f"),
        "interval": "-" if math.isnan(verdict.level) else _level(verdict),
        "boundary": shown_number(verdict.boundary),
        "p": probability(verdict.p),
        "units": f"{verdict.units} {'encoders' if verdict.by_encoder else 'runs'}",
        "why": verdict.reason or "-",
    }


def _level(verdict: Verdict) -> str:
    """The level of an interval: two digits at least of what it lacks of 100 %."""
    lacking = max(verdict.level, _LEAST_LACKING)
    digits = max(4, 1 - math.floor(math.log10(lacking)))
    return f"{100 * (1 - lacking):.{digits}g} %"


def told(claim: str, estimate: Interval) -> str:
    """The estimate of a claim, with its direction where a sign would have to be known."""
    if claim != FASTER.name or math.isnan(estimate.value):
        return shown(estimate)
    value, *ends = (_later(steps) for steps in estimate)
    return value if math.isnan(estimate.low) else f"{value} [{ends[0]}, {ends[1]}]"


def _later(steps: float) -> str:
    count = f"{abs(steps):,.0f}"
    return count if count == "0" else f"{count} {'later' if steps > 0 else 'earlier'}"


def enumerated(names: Sequence[str]) -> str:
    """Names in a sentence: a, b and c."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def scale_words(group: GroupAnalysis, planned: Planned) -> str:
    """What gains are over, and what scores 0 and 1."""
    ends = group.ends
    blind = group.best_policy
    if blind is None:
        blind = "an untrained policy" if math.isnan(group.return_floor) else "the least return"
    if math.isnan(ends.top):
        return f"gains are over {blind}, {shown_number(ends.blind)}"
    named, top = planned.rules.top, shown_number(ends.top)
    one = f"{named} {top}" if isinstance(named, str) else top
    return f"a score of 0 is {blind} {shown_number(ends.blind)}, 1 is {one}"


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
