"""An analysis as tables to read on a screen."""

from collections.abc import Mapping
from typing import Any

from jbrep.stats.labels import STEPS_TO
from jbrep.text import SIGNIFICANT, interval, number, table

Plain = Mapping[str, Any]  # statistics.json, or a part of it
Rows = tuple[tuple[str, ...], list[tuple[str, ...]]]  # a header, and the lines under it
_KEY = "representation"


def statistics_text(statistics: Plain) -> str:
    """All tables of an analysis, by task and algorithm.

    Args:
        statistics: as statistics.json has it.
    """
    parts = (
        part
        for group in statistics["groups"]
        for title, rows in group_tables(group, statistics)
        for part in (title, table(*rows))
    )
    return "\n\n".join(parts)


def group_tables(group: Plain, statistics: Plain) -> list[tuple[str, Rows]]:
    """Up to four tables, each with a line that says what it is."""
    runs = sum(len(label["seeds"]) for label in group["labels"])
    end, cut = group["grid"][-1], group["cut"]
    found = [
        (
            f"{group['task']}, {group['algorithm']}: {runs} runs over {end:,.0f} steps; 95 % "
            f"intervals over runs{f'; the comparison {cut}' if cut else ''}",
            label_rows(group),
        ),
        (
            "Spread of final returns over runs; CVaR: the mean of the worst quarter",
            spread_rows(group),
        ),
    ]
    if group["comparisons"]:
        level = f"{100 * statistics['simultaneous_level']:.2f} %"
        found += [
            (f"Against {statistics['baseline']}", comparison_rows(group)),
            (
                f"Verdicts, by the intervals at {level}, which hold together at 95 %; seeds: how "
                "many would decide",
                verdict_rows(group),
            ),
        ]
    return found


def label_rows(group: Plain) -> Rows:
    """A line for each label; the number of runs that reached a return stands behind the steps."""
    header = (
        *(_KEY, "runs", "failed", "final return", "mean return", "IQM of final"),
        *("steps to 50 %", "to 90 %", "to 900"),
    )
    return header, [
        (
            label["representation"],
            str(len(label["seeds"])),
            str(len(label["failed"])),
            _of(label, "final_return_mean"),
            _of(label, "mean_return_mean"),
            _of(label, "final_return_iqm"),
            *(_steps(label, name) for name in STEPS_TO),
        )
        for label in group["labels"]
    ]


def spread_rows(group: Plain) -> Rows:
    """A line for each label."""
    names = ("final_return_sd", "final_return_iqr", "final_return_mad", "risk_across_runs")
    return (_KEY, "SD", "IQR", "MAD", "CVaR"), [
        (label["representation"], *(_of(label, name, ",.1f") for name in names))
        for label in group["labels"]
    ]


def _of(label: Plain, name: str, form: str = ",.0f") -> str:
    return interval(label["numbers"][name], form)


def _steps(label: Plain, name: str) -> str:
    steps = number(label["numbers"][name][0], ",.0f")
    reached = label["numbers"][name.replace("steps_to", "reached")][0]
    runs = len(label["seeds"])
    return steps if reached is None else f"{steps} ({round(reached * runs)}/{runs})"


def comparison_rows(group: Plain) -> Rows:
    """A line for each comparison with the baseline."""
    header = (
        *(_KEY, "final return", "mean return", "P(improvement)", "variance ratio"),
        *("by bootstrap", "permutation p", "Brown-Forsythe p"),
    )
    return header, [
        (
            comparison["representation"],
            interval(comparison["numbers"]["final_return_difference"], ",.0f"),
            interval(comparison["numbers"]["mean_return_difference"], ",.0f"),
            interval(comparison["numbers"]["probability_of_improvement"], ".2f"),
            interval(comparison["numbers"]["variance_ratio"], SIGNIFICANT),
            interval(comparison["numbers"]["variance_ratio_bootstrap"], SIGNIFICANT),
            next(
                _probability(v["p"])
                for v in comparison["verdicts"]
                if v["claim"] == "less variance"
            ),
            _probability(comparison["brown_forsythe_p"]),
        )
        for comparison in group["comparisons"]
    ]


def verdict_rows(group: Plain) -> Rows:
    """A line for each verdict, with the interval that decides and the bound it must exclude."""
    header = (_KEY, "claim", "verdict", "interval", "bound", "p", "Holm's p", "seeds")
    return header, [
        (
            comparison["representation"],
            verdict["claim"],
            verdict["verdict"] + (f" ({verdict['reason']})" if verdict["reason"] else ""),
            interval(verdict["simultaneous"], SIGNIFICANT),
            number(verdict["boundary"], SIGNIFICANT),
            _probability(verdict["p"]),
            _probability(verdict["p_holm"]),
            "-" if verdict["seeds_needed"] is None else str(verdict["seeds_needed"]),
        )
        for comparison in group["comparisons"]
        for verdict in comparison["verdicts"]
    ]


def _probability(p: float | None) -> str:
    if p is None:
        return "-"
    return "<0.001" if p < 0.001 else f"{p:.3f}"
