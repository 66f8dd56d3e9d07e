"""The answer of a study in a few sentences: what agents return, which learned, what is decided."""

import math
from collections.abc import Iterable, Sequence

from jbrep.report.returns import by_task, named, shown_return
from jbrep.report.tables import Tables
from jbrep.report.words import enumerated, over
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.arms import FEWEST_UNITS
from jbrep.stats.claims import CONTRADICTED, EXPLORATORY, NOT_YET, SUPPORTED, UNDECIDED, Verdict
from jbrep.stats.labels import NO, UNCLEAR, YES, RepresentationResult
from jbrep.stats.scale import LOOKING
from jbrep.text import counted

_MOST = 6  # agents of a task that are named
_BEST = 3  # of more, those that end highest
_ALIKE = {
    YES: "All learned.",
    UNCLEAR: "Whether any learned isn't clear.",
    NO: "None learned.",
}
_ALONE = {
    YES: "They learned.",
    NO: "They didn't learn.",
    UNCLEAR: "Whether they learned isn't clear.",
}


def answer(tables: Tables) -> list[str]:
    """Final returns beside policies that don't learn, by task; then what follows from them."""
    if tables.analysis is None and tables.left_out:
        return [f"There is nothing to compare: {'; '.join(tables.left_out)}."]
    if tables.analysis is None:
        return [
            f"There is nothing to compare: no cell has two runs of {tables.record.baseline} and of "
            "another representation that have ended."
        ]
    tasks = by_task(tables.analysis)
    return [*map(_returns, tasks), " ".join(_conclusion(tables.analysis))]


def _returns(groups: Sequence[GroupAnalysis]) -> str:
    """What agents on a task return at the end, beside policies that don't learn."""
    group, agents = groups[0], named(groups)
    where = group.task if len(groups) > 1 else group.name
    told = f"{where}, final returns: {_listed_returns(agents, groups)}"
    blind, written = (
        [
            f"{policy} {shown_return(mean.value, groups)}"
            for policy, mean in group.references.items()
            if (policy == LOOKING) is looks
        ]
        for looks in (False, True)
    )
    for policies, how in ((blind, "policies that don't look: "), (written, "")):
        told += f"; {how}{', '.join(policies)}" if policies else ""
    told += "" if blind else "; what policies that don't look would return isn't known"
    return f"{told}. {_learnt(agents)}"


def _listed_returns(
    agents: Sequence[tuple[str, RepresentationResult]], groups: Sequence[GroupAnalysis]
) -> str:
    """Each agent's name and mean final return; of many the first and the highest."""
    values = [(name, float(label.numbers["final_return_mean"].value)) for name, label in agents]
    first = [] if len(groups) > 1 else values[:1]
    others = sorted(values[len(first) :], key=lambda each: -each[1])
    shown = [*first, *(others if len(agents) <= _MOST else others[:_BEST])]
    told = ", ".join(f"{name} {shown_return(value, groups)}" for name, value in shown)
    if rest := [value for _, value in others[len(shown) - len(first) :]]:
        high, low = (shown_return(each, groups) for each in (rest[0], rest[-1]))
        told += f", {len(rest)} others {high} to {low}"
    return told


def _learnt(agents: Sequence[tuple[str, RepresentationResult]]) -> str:
    """Which agents end above the best policy that doesn't look."""
    names = {
        state: [name for name, label in agents if label.learnt == state]
        for state in (YES, UNCLEAR, NO)
    }
    for state, which in names.items():
        if len(which) == len(agents):
            return _ALIKE[state] if len(agents) > 1 else _ALONE[state]
    told = (
        f"{word}: {', '.join(which) if len(which) <= _MOST else f'{len(which)} of {len(agents)}'}"
        for word, which in zip(("learned", "not clearly", "didn't"), names.values(), strict=True)
        if which
    )
    text = "; ".join(told)
    return f"{text[0].upper()}{text[1:]}."


def _conclusion(analysis: Analysis) -> Iterable[str]:
    """What can be concluded of the comparisons with the baseline."""
    compared = [group for group in analysis.groups if group.comparisons]
    if not compared:
        yield f"Nothing was compared with {analysis.baseline}."
        return
    silent = [group for group in compared if group.labels[0].learnt != YES]
    if silent:
        surely = "" if all(group.labels[0].learnt == NO for group in silent) else "clearly "
        where = f" on {enumerated([group.name for group in silent])}" if len(compared) > 1 else ""
        what = "but what was registered " if any(group.is_judged for group in silent) else ""
        yield (
            f"Agents on {analysis.baseline} didn't {surely}learn{where}: nothing {what}can be "
            f"compared {'there' if where else 'with them'}{_enough(analysis, silent)}."
        )
    cells = [(group, each) for group in compared for each in group.comparisons]
    judged = [(group, each) for group, each in cells if each.is_judged]
    if judged:
        several = len(compared) > 1
        yield from _decided(
            analysis.planned.rules.claims,
            [
                (f"{c.representation} ({g.name})" if several else c.representation, c.verdicts)
                for g, c in judged
            ],
        )
        if analysis.planned.rules.gains_over != "drives":
            yield f"As it was registered, gains count over {over(analysis.planned.rules)}."
    elif analysis.planned.rules.primary:
        yield (
            "Nothing is decided yet: there are no statistics of what was registered, which take "
            "two runs a side."
        )
    elif len(silent) < len(compared):
        runs = [len(label.seeds) for group in compared for label in group.labels]
        each = counted(runs[0], "run") if len({*runs}) == 1 else f"{min(runs)} to {max(runs)} runs"
        none = ": no conclusion" if max(runs) < FEWEST_UNITS else ""
        yield f"With {each} of each and no claim registered, this is exploratory{none}."


def _enough(analysis: Analysis, silent: Sequence[GroupAnalysis]) -> str:
    """What was enough where verdicts have something to go by all the same."""
    judged = (each for group in silent for each in group.comparisons if each.is_judged)
    if all(math.isnan(each.verdicts[0].estimate.value) for each in judged):
        return ""
    return f"; for that it is enough to end above {over(analysis.planned.rules)} on these starts"


def _decided(
    claims: Sequence[str], cells: Sequence[tuple[str, Sequence[Verdict]]]
) -> Iterable[str]:
    """What is found of each claim that anything is decided of; then of all others."""
    every = [verdict for _, verdicts in cells for verdict in verdicts]
    if all(verdict.verdict == NOT_YET for verdict in every):
        reasons = dict.fromkeys(verdict.reason or "" for verdict in every)
        yield f"Nothing is decided yet: {'; '.join(reasons)}."
        return
    silent = []
    for position, claim in enumerate(claims):
        names = {
            state: [name for name, verdicts in cells if verdicts[position].verdict == state]
            for state in (SUPPORTED, CONTRADICTED, UNDECIDED, NOT_YET, EXPLORATORY)
        }
        if names[UNDECIDED] == [name for name, _ in cells]:
            silent.append(repr(claim))
            continue
        told = [f"{state} for {enumerated(which)}" for state, which in names.items() if which]
        is_decided = names[SUPPORTED] + names[CONTRADICTED]
        yield f"{'Decided' if is_decided else 'Not decided'}: {claim!r} is {', '.join(told)}."
    if silent:
        verb = "is" if len(silent) == 1 else "are"
        yield f"{enumerated(silent)} {verb} undecided{' everywhere' if len(cells) > 1 else ''}."
