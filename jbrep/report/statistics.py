"""Statistics as tables."""

import math
from collections.abc import Callable, Sequence
from operator import attrgetter

from jbrep.report import facts
from jbrep.report.answer import answer
from jbrep.report.returns import return_form, returns_tables, steps
from jbrep.report.shares import share_of, shares_of_runs
from jbrep.report.tables import Tables
from jbrep.report.words import (
    EFFECTS,
    notes,
    probability,
    shown,
    told,
    verdict_cells,
)
from jbrep.rl.files import FAILED
from jbrep.stats.aggregates import Aggregate
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.association import Association
from jbrep.stats.claims import FASTER
from jbrep.stats.comparison import Comparison
from jbrep.stats.labels import RepresentationResult
from jbrep.stats.power import Prospect
from jbrep.stats.rules import Planned
from jbrep.stats.scale import SOLVED
from jbrep.study.forecast import Cost, Forecast
from jbrep.study.plan import Cell
from jbrep.study.tables import by_run
from jbrep.text import SIGNIFICANT, Table, duration, number, percentiles, rounded, table, wrapped

_KEY, _NAME = "representation", attrgetter("representation")


def statistics_text(analysis: Analysis, width: int | None = None) -> str:
    """All tables of an analysis, by task and algorithm, then across tasks, of that width."""
    tables = [each for group in analysis.groups for each in group_tables(group, analysis)]
    return "\n\n".join(each.text(width) for each in (*tables, *across_tasks(analysis)))


def results_text(tables: Tables, width: int | None = None, everything: bool = False) -> str:
    """The answer with the returns that it rests on and what is decided; all tables if wanted.

    Without statistics, each run's last evaluation.
    """
    parts = [wrapped(each, width) for each in (*facts.notices(tables), *answer(tables))]
    if analysis := tables.analysis:
        shown_first = [*returns_tables(tables), *verdict_tables(analysis)]
        parts += [each.text(width) for each in shown_first]
        if everything:
            parts.append(statistics_text(analysis, width))
    else:
        parts.append(_last(tables, width))
    return "\n\n".join(parts)


def verdict_tables(analysis: Analysis) -> list[Table]:
    """What was registered: a table for each task and algorithm."""
    found = []
    for task, algorithm in dict.fromkeys((v.task, v.algorithm) for v in analysis.verdicts):
        rows = [
            verdict_cells(verdict)
            for verdict in analysis.verdicts
            if (verdict.task, verdict.algorithm) == (task, algorithm)
        ]
        title = f"{task}, {algorithm}, registered claims"
        found.append(Table(title, tuple(rows[0]), [tuple(row.values()) for row in rows]))
    return found


def _last(tables: Tables, width: int | None) -> str:
    returns, rows = by_run(tables.returns), []
    shares = shares_of_runs(tables)
    names = list(dict.fromkeys(name for of_run in shares.values() for name in of_run))
    for run in tables.record.runs:
        if run.status == FAILED:
            cells = [str(run.seed), f"{run.steps:,}", "failed", *["-"] * (1 + len(names))]
            rows.append((run.label, *cells))
            continue
        step, final = max(returns[run.label, run.seed].items())
        median, low, high = rounded(*percentiles(final).values())
        own = [number(shares[run.label, run.seed].get(name), ".2f") for name in names]
        rows.append((run.label, str(run.seed), f"{step:,}", median, f"[{low}, {high}]", *own))
    header = ("run", "seed", "steps", "median return", "10-90 %", *map(share_of, names))
    return table(header, rows, width)


def group_tables(group: GroupAnalysis, analysis: Analysis) -> list[Table]:
    """Up to four tables of a task and algorithm."""
    tables = [label_table(group), _spread_table(group)]
    if any(label.encoders > 1 for label in group.labels):
        tables.append(_component_table(group))
    if group.compared:
        tables.append(comparison_table(group, analysis.baseline))
    return tables


def label_table(group: GroupAnalysis) -> Table:
    """A row for each representation, then for each policy that doesn't learn.

    After the steps there is how many runs reached the return; steps to a return that isn't known
    are left out.
    """
    runs = sum(len(label.seeds) for label in group.labels)
    cut = f"; the comparison {group.cut}" if group.cut else ""
    form = return_form([group])
    columns: dict[str, Callable[[RepresentationResult], str]] = {
        _KEY: _NAME,
        "runs": lambda label: str(len(label.seeds)),
        "failed": lambda label: str(len(label.failed)),
        "final return": _number("final_return_mean", form),
        "mean return": _number("mean_return_mean", form),
        "IQM of final": _number("final_return_iqm", form),
        "steps to 50 %": lambda label: steps(label, "steps_to_50_percent"),
        "to 90 %": lambda label: steps(label, "steps_to_90_percent"),
    }
    if not math.isnan(group.solved):
        columns[f"to solved ({group.solved:,g})"] = lambda label: steps(label, SOLVED)
    title = f"{group.name}: {runs} runs over {group.grid[-1]:,.0f} steps; 95 % intervals over runs"
    found = Table.of(f"{title}{cut}", group.labels, columns)
    references = [
        (policy, "-", "-", shown(each, form), *["-"] * (len(columns) - 4))
        for policy, each in group.references.items()
    ]
    return found._replace(rows=[*found.rows, *references])


def _number(
    name: str, form: str = SIGNIFICANT
) -> Callable[[RepresentationResult | Comparison], str]:
    """A column of one of their numbers."""
    return lambda each: shown(each.numbers[name], form)


def _spread_table(group: GroupAnalysis) -> Table:
    form = return_form([group], more=1)
    return Table.of(
        "Spread of final returns over runs; CVaR is the mean of the worst quarter",
        group.labels,
        {
            _KEY: _NAME,
            "SD": _number("final_return_sd", form),
            "IQR": _number("final_return_iqr", form),
            "MAD": _number("final_return_mad", form),
            "CVaR": _number("risk_across_runs", form),
        },
    )


def _component_table(group: GroupAnalysis) -> Table:
    """A row for each representation of several encoders."""
    return Table.of(
        "Variance of final returns: of encoders and of runs",
        [label for label in group.labels if label.encoders > 1],
        {
            _KEY: _NAME,
            "encoders": lambda label: str(label.encoders),
            "their variance": _number("encoder_variance"),
            "variance of runs": _number("run_variance"),
            "ratio": _number("encoder_variance_ratio"),
        },
    )


def comparison_table(group: GroupAnalysis, baseline: str) -> Table:
    """A row for each comparison with the baseline; differences are taken seed by seed."""
    form = return_form([group])
    return Table.of(
        f"{group.name}, compared with {baseline}",
        group.compared,
        {
            _KEY: _NAME,
            "final return": _number("final_return_difference", form),
            "score": _number("score_difference", ".2f"),
            "share of gain": _number("share_of_gain", ".2f"),
            "mean return": _number("mean_return_difference", form),
            "steps to half of the gain": lambda comparison: told(
                FASTER.name, comparison.numbers["steps_later"]
            ),
            "P(improvement)": _number("probability_of_improvement", ".2f"),
            "spread of curves": _number("spread_ratio", ".2f"),
            "variance ratio": _number("variance_ratio"),
            "Brown-Forsythe p": lambda comparison: probability(comparison.brown_forsythe_p),
        },
    )


def across_tasks(analysis: Analysis) -> list[Table]:
    """A table for each algorithm with scores on several tasks."""
    by_algorithm: dict[str, list[Aggregate]] = {}
    for each in analysis.aggregates:
        by_algorithm.setdefault(each.algorithm, []).append(each)
    return [
        Table.of(
            f"{algorithm} across {', '.join(of_algorithm[0].tasks)}: scores; 95 % intervals over "
            "runs within tasks",
            of_algorithm,
            {
                _KEY: _NAME,
                "runs": lambda each: f"{each.runs} of each",
                "IQM": lambda each: shown(each.iqm, ".2f"),
                "optimality gap": lambda each: shown(each.optimality_gap, ".2f"),
            },
        )
        for algorithm, of_algorithm in by_algorithm.items()
    ]


def association_tables(associated: list[Association]) -> list[Table]:
    """How well diagnostics predict learning, a table for each task and algorithm."""
    return [
        Table.of(
            f"{name}: do diagnostics predict learning? Rank correlation with the final return over "
            "codes, positive where the better value goes with the higher return; 95 % bootstrap "
            "intervals over families of codes, by how they are made",
            [each for each in associated if each.group.name == name],
            {
                "diagnostic": lambda each: each.diagnostic.name,
                "what it is": lambda each: each.diagnostic.words,
                "rank correlation": lambda each: shown(each.correlation, ".2f"),
                "codes": lambda each: str(len(each.values)),
                "families": lambda each: str(len(set(each.families))),
            },
        )
        for name in dict.fromkeys(each.group.name for each in associated)
    ]


def forecast_text(forecast: Forecast, planned: Planned, width: int | None = None) -> str:
    """The runs to go, how long they would take, and what could be found of its claims."""
    summary = (
        f"{len(forecast.runs)} runs to go, {forecast.done} done; "
        f"{duration(sum(time for _, time in forecast.runs))} on one core, "
        f"{duration(forecast.elapsed)} with "
        f"{forecast.workers} workers, besides data and encoders"
    )
    parts = [_to_go(forecast.runs).text(width)] if forecast.runs else []
    parts.append(wrapped(summary, width))
    if forecast.made_first:
        parts.append(_made_first(forecast.made_first).text(width))
    if forecast.prospects:
        parts.append(prospects_table(forecast.prospects).text(width))
        parts += [wrapped(each, width) for each in (*notes(planned), EFFECTS)]
    return "\n\n".join(parts)


def _made_first(costs: Sequence[Cost]) -> Table:
    """A row for the data sets of each name, and for the encoders of each representation."""
    columns = {
        "made first": lambda cost: cost.what,
        "to go": lambda cost: str(cost.to_go),
        "done": lambda cost: str(cost.done),
        "time on one core": lambda cost: duration(cost.seconds),
    }
    return Table.of("", costs, columns)


def _to_go(runs: Sequence[tuple[Cell, float]]) -> Table:
    """A row for the runs of each label, and how long each takes."""
    of_labels: dict[str, list[float]] = {}
    for cell, time in runs:
        of_labels.setdefault(cell.label, []).append(time)
    columns = {
        "agents": lambda each: each[0],
        "runs": lambda each: str(len(each[1])),
        "time of each": lambda each: duration(max(each[1])),
    }
    return Table.of("", of_labels.items(), columns)


def prospects_table(prospects: Sequence[Prospect]) -> Table:
    """What can be found of each claim on each task and algorithm."""
    return Table.of(
        "",
        prospects,
        {
            "on": lambda each: each.where,
            "claim": lambda each: str(each.claim),
            "units": lambda each: str(each.units),
            "level": lambda each: probability(each.level),
            "least p": lambda each: probability(each.least_p),
            "power": lambda each: ", ".join(f"{100 * power:.0f} %" for power in each.power),
            "unseen": lambda each: f"{100 * each.unseen:.0f} %",
        },
    )
