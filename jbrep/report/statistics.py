"""Statistics as tables."""

import math

import numpy as np

from jbrep.report.tables import Tables
from jbrep.report.words import (
    EFFECTS,
    notes,
    probability,
    reference_words,
    remark,
    shown,
    shown_number,
    statements,
)
from jbrep.rl.files import FAILED
from jbrep.stats.aggregates import Aggregate
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.association import Association
from jbrep.stats.labels import COMPONENTS, REACHED, RepresentationResult
from jbrep.stats.power import Prospect
from jbrep.stats.rules import Planned
from jbrep.stats.scale import STEPS_TO
from jbrep.study.packing import Forecast
from jbrep.study.tables import by_run
from jbrep.text import Table, duration, rounded, table, wrapped

_KEY = "representation"
_MOST_DIGITS = 9  # after the point
_SPREADS = ("final_return_sd", "final_return_iqr", "final_return_mad", "risk_across_runs")


def statistics_text(analysis: Analysis, width: int | None = None) -> str:
    """All tables of an analysis: by task and algorithm, then across tasks.

    Args:
        analysis: of a study.
        width: that tables must fit, in columns; None for tables of any width.
    """
    tables = [each for group in analysis.groups for each in group_tables(group, analysis)]
    return "\n\n".join(each.text(width) for each in (*tables, *across_tasks(analysis)))


def results_text(tables: Tables, width: int | None = None) -> str:
    """The statistics as tables, or each run's last evaluation where there are none.

    Args:
        tables: of runs.
        width: to fit, in columns; None for no limit.
    """
    told = statistics_text(tables.analysis, width) if tables.analysis else _last(tables, width)
    return "\n".join((told, *(f"\nno statistics: {line}" for line in tables.left_out)))


def _last(tables: Tables, width: int | None) -> str:
    returns, rows = by_run(tables.returns), []
    for run in tables.record.runs:
        if run.status == FAILED:
            rows.append((run.label, str(run.seed), f"{run.steps:,}", "failed", "-"))
            continue
        step, final = max(returns[run.label, run.seed].items())
        low, median, high = rounded(*np.percentile(final, (10, 50, 90)))
        rows.append((run.label, str(run.seed), f"{step:,}", median, f"[{low}, {high}]"))
    return table(("run", "seed", "steps", "median return", "10-90 %"), rows, width)


def group_tables(group: GroupAnalysis, analysis: Analysis) -> list[Table]:
    """Up to five tables of a task and algorithm."""
    tables = [label_table(group), _spread_table(group)]
    if any(label.encoders > 1 for label in group.labels):
        tables.append(_component_table(group))
    if any(comparison.is_open for comparison in group.comparisons):
        tables.append(_comparison_table(group, analysis.baseline))
    if group.comparisons:
        judged = any(comparison.is_judged for comparison in group.comparisons)
        table = _verdict_table(group) if judged else _estimate_table(group, analysis.planned)
        how = (*notes(analysis.planned), f"Gains are counted from {reference_words(group)}.")
        tables.append(table._replace(title=f"{table.title}. {' '.join(how)}"))
    return tables


def label_table(group: GroupAnalysis) -> Table:
    """A row for each representation, then for each policy that doesn't learn.

    After the steps there is how many runs reached the return; steps to a return that isn't known
    are left out.
    """
    runs = sum(len(label.seeds) for label in group.labels)
    cut = f"; the comparison {group.cut}" if group.cut else ""
    solved = [] if math.isnan(group.solved) else [f"to solved ({group.solved:,g})"]
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
    return Table(
        f"{group.name}: {runs} runs over {group.grid[-1]:,.0f} steps; 95 % intervals over runs"
        f"{cut}",
        (
            *(_KEY, "runs", "failed", "final return", "mean return", "IQM of final"),
            *("steps to 50 %", "to 90 %", *solved),
        ),
        [*rows, *references],
    )


def _steps(label: RepresentationResult, name: str) -> str:
    steps = shown_number(label.numbers[name].value, ",.0f")
    reached, runs = label.numbers[REACHED[name]].value, len(label.seeds)
    return steps if math.isnan(reached) else f"{steps} ({round(reached * runs)}/{runs})"


def _form(group: GroupAnalysis, more: int = 0) -> str:
    """A format for returns: three digits of the range of final returns, or whole numbers.

    Args:
        group: with the returns.
        more: digits, such as for their spread.
    """
    width = group.profile_returns[-1] - group.profile_returns[0]
    return f",.{np.clip(2 - math.floor(math.log10(width)), 0, _MOST_DIGITS) + more}f"


def _spread_table(group: GroupAnalysis) -> Table:
    form = _form(group, more=1)
    return Table(
        "Spread of final returns over runs; CVaR is the mean of the worst quarter",
        (_KEY, "SD", "IQR", "MAD", "CVaR"),
        [
            (label.representation, *(shown(label.numbers[name], form) for name in _SPREADS))
            for label in group.labels
        ],
    )


def _component_table(group: GroupAnalysis) -> Table:
    """A row for each representation of several encoders."""
    return Table(
        "Variance of final returns: of encoders and of runs",
        (_KEY, "encoders", "their variance", "variance of runs", "ratio"),
        [
            (
                label.representation,
                str(label.encoders),
                *(shown(label.numbers[name]) for name in COMPONENTS),
            )
            for label in group.labels
            if label.encoders > 1
        ],
    )


def _comparison_table(group: GroupAnalysis, baseline: str) -> Table:
    """A row for each comparison with the baseline, but for those that wait for a look."""
    form = _form(group)
    return Table(
        f"Compared with {baseline}",
        (
            *(_KEY, "final return", "mean return", "P(improvement)", "variance ratio"),
            *("by bootstrap", "Brown-Forsythe p"),
        ),
        [
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
        ],
    )


def _verdict_table(group: GroupAnalysis) -> Table:
    """A row for each verdict, with the interval that decides and the boundary."""
    return Table(
        "Verdicts",
        ("representation: claim", "verdict", "estimate", "boundary", "p", "level", "runs"),
        [
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
        ],
    )


def _estimate_table(group: GroupAnalysis, planned: Planned) -> Table:
    """A row for each comparison without verdicts: estimates, where claims share one only once."""
    claims = statements(planned)
    estimands = [claim.estimand for claim in claims]
    columns = [i for i, each in enumerate(estimands) if estimands.index(each) == i]
    return Table(
        "What the claims are about",
        (_KEY, *(claims[i].name for i in columns)),
        [
            (comparison.representation, *(shown(comparison.verdicts[i].estimate) for i in columns))
            for comparison in group.comparisons
        ],
    )


def matrix(group: GroupAnalysis, planned: Planned) -> Table:
    """A row for each comparison, a column for each claim; of estimates where nothing is judged."""
    if not any(comparison.is_judged for comparison in group.comparisons):
        return _estimate_table(group, planned)
    return Table(
        "Verdicts",
        (_KEY, *planned.rules.claims),
        [
            (
                comparison.representation,
                *("; ".join(filter(None, (v.verdict, remark(v)))) for v in comparison.verdicts),
            )
            for comparison in group.comparisons
        ],
    )


def across_tasks(analysis: Analysis) -> list[Table]:
    """A table for each algorithm that learned several tasks."""
    by_algorithm: dict[str, list[Aggregate]] = {}
    for each in analysis.open_aggregates:
        by_algorithm.setdefault(each.algorithm, []).append(each)
    return [
        Table(
            f"{algorithm} across {', '.join(of_algorithm[0].tasks)}: gains over standing still as "
            f"shares of that on {analysis.baseline}; 95 % intervals over runs within tasks",
            (_KEY, "runs", "IQM", "optimality gap"),
            [
                (
                    each.representation,
                    f"{each.runs} of each",
                    shown(each.iqm, ".2f"),
                    shown(each.optimality_gap, ".2f"),
                )
                for each in of_algorithm
            ],
        )
        for algorithm, of_algorithm in by_algorithm.items()
    ]


def association_tables(associated: list[Association]) -> list[Table]:
    """How well diagnostics predict learning, a table for each task and algorithm."""
    return [
        Table(
            f"{name}: do diagnostics predict learning? Rank correlation with the final return over "
            "codes, positive where the better value goes with the higher return; 95 % bootstrap "
            "intervals over codes",
            ("diagnostic", "what it is", "rank correlation", "codes"),
            [
                (
                    each.diagnostic.name,
                    each.diagnostic.words,
                    shown(each.correlation, ".2f"),
                    str(len(each.values)),
                )
                for each in associated
                if each.group.name == name
            ],
        )
        for name in dict.fromkeys(each.group.name for each in associated)
    ]


def forecast_text(forecast: Forecast, planned: Planned, width: int | None = None) -> str:
    """The runs to go, how long they would take, and what could be found in primary cells."""
    rows = [(cell.name, str(cohort), duration(time)) for cell, cohort, time in forecast.runs]
    summary = (
        f"{len(rows)} runs to go, {forecast.done} done; {duration(forecast.seconds)} on one core, "
        f"{duration(forecast.elapsed)} with {forecast.workers} workers, besides data and encoders"
    )
    parts = [table(("run", "cohort", "time"), rows, width)] if rows else []
    parts.append(wrapped(summary, width))
    if forecast.prospects:
        header = ("primary cell: claim", "runs", "level", "least p", "power")
        parts.append(table(header, map(_prospect, forecast.prospects), width))
        parts += [wrapped(each, width) for each in (*notes(planned), EFFECTS)]
    return "\n\n".join(parts)


def _prospect(prospect: Prospect) -> tuple[str, ...]:
    """What could be found of a claim in a primary cell."""
    return (
        f"{prospect.cell}: {prospect.claim}",
        f"{prospect.arms.units} and {prospect.arms.baseline}",
        probability(prospect.level),
        probability(prospect.least_p),
        ", ".join(f"{100 * power:.0f} %" for power in prospect.power),
    )
