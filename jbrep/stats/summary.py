"""An analysis as tables to read in a terminal."""

import math
import textwrap

import numpy as np

from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.bootstrap import Interval
from jbrep.stats.first_claims import LESS_VARIANCE, MARGIN
from jbrep.stats.labels import REACHED, RepresentationResult
from jbrep.stats.scale import STEPS_TO
from jbrep.text import SIGNIFICANT, interval, number, table

Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]  # a header, and the rows below it
_KEY = "representation"
_MOST_DIGITS = 9  # after the point


def statistics_text(analysis: Analysis, width: int | None = None) -> str:
    """All tables of an analysis, by task and algorithm.

    Args:
        analysis: of a study.
        width: that tables must fit, in columns; None for tables of any width.
    """
    parts = (
        part
        for group in analysis.groups
        for title, (header, rows) in group_tables(group, analysis)
        for part in (_wrapped(title, width), table(header, rows, width))
    )
    return "\n\n".join(parts)


def _wrapped(title: str, width: int | None) -> str:
    return title if width is None else textwrap.fill(title, width, break_on_hyphens=False)


def group_tables(group: GroupAnalysis, analysis: Analysis) -> list[tuple[str, Rows]]:
    """Up to four tables, each with a title."""
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
    if group.comparisons:
        level = f"{100 * analysis.simultaneous_level:.2f} %"
        tables += [
            (f"Compared with {analysis.baseline}", comparison_rows(group)),
            (
                f"Verdicts, by intervals at {level}, which hold together at 95 %; seeds: the "
                f"number per representation that would decide. {margin(group)}",
                verdict_rows(group),
            ),
        ]
    return tables


def margin(group: GroupAnalysis) -> str:
    """The margin of the claim of similar reward, in a line."""
    known = not math.isnan(group.return_floor)
    what = "the least possible return" if known else "the mean return of its untrained policies"
    return (
        f"Similar reward: a loss of up to {100 * MARGIN:.0f} % of the gain of "
        f"{group.labels[0].representation} over {what}, {shown_number(group.reference)}"
    )


def label_rows(group: GroupAnalysis) -> Rows:
    """A row for each representation; after the steps, how many of its runs reached the return.

    Steps to a return that isn't known are left out.
    """
    solved = [] if math.isnan(group.solved) else [f"to solved ({group.solved:,g})"]
    header = (
        *(_KEY, "runs", "failed", "final return", "mean return", "IQM of final"),
        *("steps to 50 %", "to 90 %", *solved),
    )
    form = _form(group)
    return header, [
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


def _steps(label: RepresentationResult, name: str) -> str:
    steps = shown_number(label.numbers[name].value, ",.0f")
    reached, runs = label.numbers[REACHED[name]].value, len(label.seeds)
    return steps if math.isnan(reached) else f"{steps} ({round(reached * runs)}/{runs})"


def comparison_rows(group: GroupAnalysis) -> Rows:
    """A row for each comparison with the baseline."""
    header = (
        *(_KEY, "final return", "mean return", "P(improvement)", "variance ratio"),
        *("by bootstrap", "permutation p", "Brown-Forsythe p"),
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
            _probability(comparison.verdict(LESS_VARIANCE).p),
            _probability(comparison.brown_forsythe_p),
        )
        for comparison in group.comparisons
    ]


def verdict_rows(group: GroupAnalysis) -> Rows:
    """A row for each verdict, with the interval that decides and the bound it must exclude."""
    header = ("representation: claim", "verdict", "interval", "bound", "p", "Holm's p", "seeds")
    return header, [
        (
            f"{comparison.representation}: {verdict.claim}",
            verdict.verdict + (f" ({verdict.reason})" if verdict.reason else ""),
            shown(verdict.simultaneous),
            shown_number(verdict.boundary),
            _probability(verdict.p),
            _probability(verdict.p_holm),
            "-" if verdict.seeds_needed is None else str(verdict.seeds_needed),
        )
        for comparison in group.comparisons
        for verdict in comparison.verdicts
    ]


def shown(values: Interval, form: str = SIGNIFICANT) -> str:
    """A value with its interval, if it has one; a dash for what isn't finite."""
    return interval(values.tolist(), form)


def shown_number(value: float, form: str = SIGNIFICANT) -> str:
    """A number; a dash if it isn't finite."""
    return number(value if math.isfinite(value) else None, form)


def _probability(p: float) -> str:
    if math.isnan(p):
        return "-"
    return "<0.001" if p < 0.001 else f"{p:.3f}"
