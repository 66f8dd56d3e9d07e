"""Final returns beside policies that don't learn: a table for each task."""

import math
import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from jbrep.report.shares import Cells, share_cells
from jbrep.report.tables import Tables
from jbrep.report.words import scale_words, shown, shown_number
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.labels import REACHED, RepresentationResult
from jbrep.stats.pairs import FEWEST_UNITS
from jbrep.stats.scale import LOOKING
from jbrep.text import Table, possessive

_MOST_DIGITS = 9  # after the point
_NOTHING = re.compile(r"-( \(0/\d+\))?")  # cells that say nothing


def by_task(analysis: Analysis) -> list[list[GroupAnalysis]]:
    """Groups that are told together: of several algorithms on one representation, by task."""
    if any(len(group.labels) > 1 for group in analysis.groups):
        return [[group] for group in analysis.groups]
    tasks: dict[str, list[GroupAnalysis]] = {}
    for group in analysis.groups:
        tasks.setdefault(group.task, []).append(group)
    return [*tasks.values()]


def named(groups: Sequence[GroupAnalysis]) -> list[tuple[str, RepresentationResult]]:
    """The agents of groups that are told together, by what tells them apart."""
    if len(groups) > 1:
        return [(group.algorithm, group.labels[0]) for group in groups]
    return [(label.representation, label) for label in groups[0].labels]


def returns_tables(tables: Tables) -> list[Table]:
    """A table for each task: final returns, which agents learned, what they gain, shares.

    There is none without statistics.
    """
    if (analysis := tables.analysis) is None:
        return []
    shares = share_cells(tables)
    return [_returns_table(groups, analysis, shares) for groups in by_task(analysis)]


def _returns_table(groups: Sequence[GroupAnalysis], analysis: Analysis, shares: Cells) -> Table:
    """A row for each agent, then for each policy that doesn't learn; no column without content."""
    first = groups[0]
    kept = {comparison.representation: comparison for comparison in first.compared}
    form = return_form(groups)
    columns: dict[str, Callable[[RepresentationResult], str]] = {
        "runs": lambda label: str(len(label.seeds)),
        "failed": lambda label: str(len(label.failed) or "-"),
        "final return": lambda label: shown(label.numbers["final_return_mean"], form),
        "learned": lambda label: label.learnt,
        "score": lambda label: shown(label.numbers["score"], ".2f"),
        f"of {possessive(analysis.baseline)} gain": lambda label: (
            shown(kept[label.representation].numbers["share_of_gain"], ".2f")
            if label.representation in kept
            else "-"
        ),
        "rise in the last fifth": lambda label: shown(label.numbers["rise"], form),
        **_share_columns(groups, shares),
    }
    rows = [(name, *(cell(label) for cell in columns.values())) for name, label in named(groups)]
    for policy, mean in first.references.items():
        cells = dict.fromkeys(columns, "-") | {"final return": shown(mean, form)}
        rows.append((policy, *cells.values()))
    what = "algorithm" if len(groups) > 1 else "agents on"
    title = first.task if len(groups) > 1 else first.name
    several = any(len(label.seeds) > 3 for _, label in named(groups))
    title += f", {max(group.grid[-1] for group in groups):,.0f} steps"
    title += "; 95 % intervals over runs" if several else ""
    found = _without_nothing(Table(title, (what, *columns), rows))
    title += f"; {scale_words(first, analysis.planned)}"
    if first.cut and kept:
        title += "; differences are taken as far as both curves go"
    if any(comparison.by_encoder for comparison in kept.values()):
        title += f"; of {FEWEST_UNITS} encoders or more, intervals are over encoders"
    if {*shares} & {*found.header} and any(label.failed for _, label in named(groups)):
        title += "; shares of episodes leave out runs that failed"
    return found._replace(title=title)


def _share_columns(
    groups: Sequence[GroupAnalysis], shares: Cells
) -> dict[str, Callable[[RepresentationResult], str]]:
    """A column for each share that is known of these agents."""
    labels = {
        label: f"{group.task}/{group.algorithm}/{label.representation}"
        for group in groups
        for label in group.labels
    }

    def column(cells: Mapping[str, str]) -> Callable[[RepresentationResult], str]:
        return lambda label: cells.get(labels[label], "-")

    return {head: column(cells) for head, cells in shares.items()}


def _without_nothing(table: Table) -> Table:
    """The table without columns in which no cell says anything."""
    kept = [
        i
        for i in range(len(table.header))
        if not all(_NOTHING.fullmatch(row[i]) for row in table.rows)
    ]
    return table._replace(
        header=tuple(table.header[i] for i in kept),
        rows=[tuple(row[i] for i in kept) for row in table.rows],
    )


def steps(label: RepresentationResult, name: str) -> str:
    """The median step at which a return is reached, and how many runs reach it."""
    median = shown_number(label.numbers[name].value, ",.0f")
    reached, runs = label.numbers[REACHED[name]].value, len(label.seeds)
    return median if math.isnan(reached) else f"{median} ({round(reached * runs)}/{runs})"


def return_form(groups: Sequence[GroupAnalysis], more: int = 0) -> str:
    """A format for returns: three digits of the range of final returns, or more of them.

    Those of policies that don't look are among them. Of a range that is small beside the returns
    themselves, as many as give these five.
    """
    final = [label.by_run["final_return"] for group in groups for label in group.labels]
    blind = [
        mean.value
        for group in groups
        for policy, mean in group.references.items()
        if policy != LOOKING
    ]
    returns = np.concatenate((*final, blind))
    known = returns[np.isfinite(returns)]
    width = max(np.ptp(known), np.abs(known).max() / 100) if len(known) else 0.0
    return f",.{np.clip(2 - math.floor(math.log10(width or 1.0)), 0, _MOST_DIGITS) + more}f"


def shown_return(value: float, groups: Sequence[GroupAnalysis]) -> str:
    """A return as tables show it."""
    return shown_number(float(value), return_form(groups))
