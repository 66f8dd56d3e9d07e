"""The answer of a study in a few sentences: what agents return, which learned, what is decided."""

from collections.abc import Iterable, Sequence

from jbrep.report.returns import by_task, named, shown_return
from jbrep.report.tables import Tables
from jbrep.report.words import conclusion, enumerated
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.labels import NO, UNCLEAR, YES, RepresentationResult
from jbrep.stats.pairs import FEWEST_UNITS
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
    """What is decided, and what can be said of comparisons with the baseline."""
    if verdicts := analysis.verdicts:
        yield conclusion(verdicts)
    compared = [group for group in analysis.groups if group.comparisons]
    if not compared:
        yield f"Nothing was compared with {analysis.baseline}."
        return
    if silent := [group for group in compared if group.labels[0].learnt != YES]:
        surely = "" if all(group.labels[0].learnt == NO for group in silent) else "clearly "
        where = f" on {enumerated([group.name for group in silent])}" if len(compared) > 1 else ""
        yield (
            f"Agents on {analysis.baseline} didn't {surely}learn{where}: nothing else can be "
            f"compared with them{' there' if where else ''}."
        )
    if rising := _rising(analysis):
        yield f"Still rising at the end of training: {rising}."
    if not verdicts and len(silent) < len(compared):
        runs = [len(label.seeds) for group in compared for label in group.labels]
        each = counted(runs[0], "run") if len({*runs}) == 1 else f"{min(runs)} to {max(runs)} runs"
        none = ": no conclusion" if max(runs) < FEWEST_UNITS else ""
        yield f"With {each} of each and no claim registered, this is exploratory{none}."


def _rising(analysis: Analysis) -> str:
    """The representations whose curves surely still rise, by task and algorithm."""
    rising = {
        group.name: [label.representation for label in group.labels if label.rises]
        for group in analysis.groups
    }
    told = {name: ", ".join(which) for name, which in rising.items() if which}
    if len(analysis.groups) == 1:
        return "".join(told.values())
    return "; ".join(f"{which} ({name})" for name, which in told.items())
