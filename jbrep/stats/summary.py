"""An analysis as tables to read in a terminal."""

import math
import textwrap
from collections.abc import Sequence

import numpy as np

from jbrep.stats.aggregates import Aggregate
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.bootstrap import Interval
from jbrep.stats.labels import COMPONENTS, REACHED, RepresentationResult
from jbrep.stats.scale import STEPS_TO, STILL
from jbrep.stats.verdict import Statement
from jbrep.text import SIGNIFICANT, interval, number, table

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]  # a header, and the rows below it
_KEY = "representation"
_MOST_DIGITS = 9  # after the point


def statistics_text(analysis: Analysis, width: int | None = None) -> str:
    """All tables of an analysis: by task and algorithm, then across tasks.

    Args:
        analysis: of a study.
        width: that tables must fit, in columns; None for tables of any width.
    """
    tables = [each for group in analysis.groups for each in group_tables(group, analysis)]
    parts = (
        part
        for title, (header, rows) in (*tables, *across_tasks(analysis))
        for part in (_wrapped(title, width), table(header, rows, width))
    )
    return "\n\n".join(parts)


def _wrapped(title: str, width: int | None) -> str:
    return title if width is None else textwrap.fill(title, width, break_on_hyphens=False)


def group_tables(group: GroupAnalysis, analysis: Analysis) -> list[tuple[str, Rows]]:
    """Up to five tables, each with a title."""
    runs = sum(len(label.seeds) for label in group.labels)
    cut = f"; the comparison {group.cut}" if group.cut else ""
    tables = [
        (
            f"{group.name}: {runs} runs over {group.grid[-1]:,.0f} steps; 95 % intervals over runs"
            f"{cut}",
            label_rows(group),
        ),
        (
            "Spread of final returns over runs; CVaR is the mean of the worst quarter",
            spread_rows(group),
        ),
    ]
    if any(label.encoders > 1 for label in group.labels):
        tables.append(("Variance of final returns: of encoders and of runs", component_rows(group)))
    if any(comparison.is_open for comparison in group.comparisons):
        tables.append((f"Compared with {analysis.baseline}", comparison_rows(group)))
    if group.comparisons:
        judged = any(comparison.is_judged for comparison in group.comparisons)
        rows = verdict_rows(group) if judged else estimate_rows(group, analysis.claims)
        from_where = f"Gains are counted from {reference_words(group)}."
        what = "Verdicts" if judged else "What the claims are about"
        tables.append((f"{what}. {' '.join((*analysis.notes, from_where))}", rows))
    return tables


def across_tasks(analysis: Analysis) -> list[tuple[str, Rows]]:
    """A table for each algorithm that learned several tasks, with a title."""
    header = (_KEY, "runs", "IQM", "optimality gap")
    return [
        (
            f"{algorithm} across {', '.join(first.tasks)}: gains over standing still as shares of "
            f"that on {analysis.baseline}; 95 % intervals over runs within tasks",
            (
                header,
                [
                    (
                        each.representation,
                        f"{each.runs} of each",
                        shown(each.iqm, ".2f"),
                        shown(each.optimality_gap, ".2f"),
                    )
                    for each in (first, *others)
                ],
            ),
        )
        for algorithm, (first, *others) in _by_algorithm(analysis.open_aggregates).items()
    ]


def _by_algorithm(aggregates: Sequence[Aggregate]) -> dict[str, list[Aggregate]]:
    found: dict[str, list[Aggregate]] = {}
    for each in aggregates:
        found.setdefault(each.algorithm, []).append(each)
    return found


def reference_words(group: GroupAnalysis) -> str:
    """What gains are counted from."""
    if STILL in group.references:
        what = "what standing still returns"
    elif not math.isnan(group.return_floor):
        what = "the least possible return"
    else:
        what = "the mean return of untrained policies"
    return f"{what}, {shown_number(group.reference)}"


def label_rows(group: GroupAnalysis) -> Rows:
    """A row for each representation, then for each policy that doesn't learn.

    After the steps there is how many runs reached the return; steps to a return that isn't known
    are left out.
    """
    solved = [] if math.isnan(group.solved) else [f"to solved ({group.solved:,g})"]
    header = (
        *(_KEY, "runs", "failed", "final return", "mean return", "IQM of final"),
        *("steps to 50 %", "to 90 %", *solved),
    )
    form = _form(group)
    rows = [
        (
            label.representation,
            str(len(label.seeds)),
            str(len(label.failed)),
            shown(label.numbers["final_return_mean"], form),
            shown(label.numbers["mean_return_mean"], form),
            shown(label.numbers["final_return_iqm"], form),
            *(_steps(label, name) for name in STEPS_TO[: 2 + len(solved)]),
        )
        for label in group.labels
    ]
    references = [
        (policy, "-", "-", shown(each, form), *["-"] * (4 + len(solved)))
        for policy, each in group.references.items()
    ]
    return header, [*rows, *references]


def _form(group: GroupAnalysis, more: int = 0) -> str:
    """A format for returns: three digits of the range of final returns, or whole numbers.

    Args:
        group: with the returns.
        more: digits, such as for their spread.
    """
    width = group.profile_returns[-1] - group.profile_returns[0]
    return f",.{np.clip(2 - math.floor(math.log10(width)), 0, _MOST_DIGITS) + more}f"


def spread_rows(group: GroupAnalysis) -> Rows:
    """A row for each representation."""
    names = ("final_return_sd", "final_return_iqr", "final_return_mad", "risk_across_runs")
    form = _form(group, more=1)
    return (_KEY, "SD", "IQR", "MAD", "CVaR"), [
        (label.representation, *(shown(label.numbers[name], form) for name in names))
        for label in group.labels
    ]


def component_rows(group: GroupAnalysis) -> Rows:
    """A row for each representation of several encoders."""
    return (_KEY, "encoders", "their variance", "variance of runs", "ratio"), [
        (
            label.representation,
            str(label.encoders),
            *(shown(label.numbers[name]) for name in COMPONENTS),
        )
        for label in group.labels
        if label.encoders > 1
    ]


def _steps(label: RepresentationResult, name: str) -> str:
    steps = shown_number(label.numbers[name].value, ",.0f")
    reached, runs = label.numbers[REACHED[name]].value, len(label.seeds)
    return steps if math.isnan(reached) else f"{steps} ({round(reached * runs)}/{runs})"


def comparison_rows(group: GroupAnalysis) -> Rows:
    """A row for each comparison with the baseline, but for those that wait for a look."""
    header = (
        *(_KEY, "final return", "mean return", "P(improvement)", "variance ratio"),
        *("by bootstrap", "Brown-Forsythe p"),
    )
    form = _form(group)
    return header, [
        (
            comparison.representation,
            shown(comparison.numbers["final_return_difference"], form),
            shown(comparison.numbers["mean_return_difference"], form),
            shown(comparison.numbers["probability_of_improvement"], ".2f"),
            shown(comparison.numbers["variance_ratio"]),
            shown(comparison.numbers["variance_ratio_bootstrap"]),
            probability(comparison.brown_forsythe_p),
        )
        for comparison in group.comparisons
        if comparison.is_open
    ]


def verdict_rows(group: GroupAnalysis) -> Rows:
    """A row for each verdict, with the interval that decides and the boundary."""
    header = ("representation: claim", "verdict", "estimate", "boundary", "p", "level", "runs")
    return header, [
        (
            f"{comparison.representation}: {verdict.claim}",
            verdict.verdict + (f" ({verdict.reason})" if verdict.reason else ""),
            shown(verdict.estimate if math.isnan(verdict.level) else verdict.interval),
            shown_number(verdict.boundary),
            probability(verdict.p),
            probability(verdict.level),
            " and ".join(map(str, verdict.runs)),
        )
        for comparison in group.comparisons
        for verdict in comparison.verdicts
    ]


def estimate_rows(group: GroupAnalysis, claims: Sequence[Statement]) -> Rows:
    """A row for each comparison without verdicts: estimates, where claims share one only once."""
    estimands = [claim.estimand for claim in claims]
    columns = [i for i, each in enumerate(estimands) if estimands.index(each) == i]
    return (_KEY, *(claims[i].name for i in columns)), [
        (comparison.representation, *(shown(comparison.verdicts[i].estimate) for i in columns))
        for comparison in group.comparisons
    ]


def shown(values: Interval, form: str = SIGNIFICANT) -> str:
    """A value with its interval, if it has one; a dash for what isn't finite."""
    return interval(values.tolist(), form)


def shown_number(value: float, form: str = SIGNIFICANT) -> str:
    """A number; a dash if it isn't finite."""
    return number(value if math.isfinite(value) else None, form)


def probability(p: float) -> str:
    """A probability to three digits; a dash where there is none."""
    if math.isnan(p):
        return "-"
    return "<0.001" if p < 0.001 else f"{p:.3f}"
