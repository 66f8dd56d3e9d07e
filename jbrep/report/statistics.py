"""Statistics as tables."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any

from jbrep.report import facts
from jbrep.report.answer import answer
from jbrep.report.returns import return_form, returns_tables, steps
from jbrep.report.shares import share_of, shares_of_runs
from jbrep.report.tables import Tables
from jbrep.report.words import (
    EFFECTS,
    caveats,
    deciding,
    notes,
    over,
    probability,
    reference_words,
    remark,
    shown,
    shown_number,
    statements,
    told,
)
from jbrep.rl.files import FAILED
from jbrep.stats.aggregates import Aggregate
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.association import Association
from jbrep.stats.comparison import Comparison
from jbrep.stats.labels import RepresentationResult
from jbrep.stats.power import Prospect
from jbrep.stats.rules import Planned
from jbrep.stats.scale import SOLVED
from jbrep.study.packing import Forecast
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
        shown_first = [*returns_tables(tables), *decided_tables(analysis)]
        parts += [each.text(width) for each in shown_first]
        if everything:
            parts.append(statistics_text(analysis, width))
    else:
        parts.append(_last(tables, width))
    return "\n\n".join(parts)


def decided_tables(analysis: Analysis) -> list[Table]:
    """What was tested: a table for each task and algorithm with primary cells."""
    found = []
    for group in analysis.groups:
        decided = [
            (comparison.representation, verdict)
            for comparison in group.comparisons
            for verdict in comparison.verdicts
            if not math.isnan(verdict.level)
        ]
        rows = [
            (
                f"{name}: {verdict.claim}",
                verdict.verdict,
                "-" if math.isnan(verdict.interval.low) else deciding(verdict),
            )
            for name, verdict in decided
        ]
        boundaries = ", ".join(
            f"{claim} {boundary:g}"
            for claim, boundary in {v.claim: v.boundary for _, v in decided}.items()
        )
        title = f"{group.name}, boundaries: {boundaries}"
        header = ("registered claim", "verdict", "interval that decides")
        if rows:
            found.append(Table(title, header, rows))
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
    """Up to five tables of a task and algorithm."""
    tables = [label_table(group), _spread_table(group)]
    if any(label.encoders > 1 for label in group.labels):
        tables.append(_component_table(group))
    if any(comparison.is_open for comparison in group.compared):
        tables.append(_comparison_table(group, analysis.baseline))
    if group.compared:
        table = (
            _verdict_table(group) if group.is_judged else _estimate_table(group, analysis.planned)
        )
        how = (*notes(analysis.planned), f"Gains are counted over {reference_words(group)}.")
        tables.append(table._replace(title=f"{table.title}. {' '.join(how)}"))
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


def _comparison_table(group: GroupAnalysis, baseline: str) -> Table:
    """A row for each comparison with the baseline, but for those that wait for a look."""
    form = return_form([group])
    return Table.of(
        f"Compared with {baseline}",
        [comparison for comparison in group.compared if comparison.is_open],
        {
            _KEY: _NAME,
            "final return": _number("final_return_difference", form),
            "mean return": _number("mean_return_difference", form),
            "P(improvement)": _number("probability_of_improvement", ".2f"),
            "variance ratio": _number("variance_ratio"),
            "by bootstrap": _number("variance_ratio_bootstrap"),
            "Brown-Forsythe p": lambda comparison: probability(comparison.brown_forsythe_p),
        },
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
                told(
                    verdict.claim,
                    verdict.estimate if math.isnan(verdict.level) else verdict.interval,
                ),
                shown_number(verdict.boundary),
                probability(verdict.p),
                probability(verdict.level),
                " and ".join(map(str, verdict.runs)),
            )
            for comparison in group.compared
            for verdict in comparison.verdicts
        ],
    )


def _estimate_table(group: GroupAnalysis, planned: Planned) -> Table:
    """A row for each comparison without verdicts: estimates, where claims share one only once."""
    claims = statements(planned)
    heads = [claim.head for claim in claims]
    columns = [i for i, each in enumerate(heads) if heads.index(each) == i]
    return Table(
        group.name,
        (_KEY, *(heads[i] for i in columns)),
        [
            (
                comparison.representation,
                *(told(claims[i].name, comparison.verdicts[i].estimate) for i in columns),
            )
            for comparison in group.compared
        ],
    )


def matrix(group: GroupAnalysis, planned: Planned) -> Table:
    """A row for each comparison, a column for each claim; of estimates where nothing is judged."""
    if not group.is_judged:
        return _estimate_table(group, planned)
    return Table(
        "Verdicts",
        (_KEY, *planned.rules.claims),
        [
            (
                comparison.representation,
                *("; ".join(filter(None, (v.verdict, remark(v)))) for v in comparison.verdicts),
            )
            for comparison in group.compared
        ],
    )


def across_tasks(analysis: Analysis) -> list[Table]:
    """A table for each algorithm that learned several tasks."""
    by_algorithm: dict[str, list[Aggregate]] = {}
    for each in analysis.open_aggregates:
        by_algorithm.setdefault(each.algorithm, []).append(each)
    return [
        Table.of(
            f"{algorithm} across {', '.join(of_algorithm[0].tasks)}: gains over {_over(analysis)} "
            f"as shares of that on {analysis.baseline}; 95 % intervals over runs within tasks",
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


def _over(analysis: Analysis) -> str:
    known = all(group.reference_policy for group in analysis.groups)
    return over(analysis.planned.rules) if known else "what each task's own table says"


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
    """The runs to go, how long they would take, and what could be found in primary cells."""
    summary = (
        f"{len(forecast.runs)} runs to go, {forecast.done} done; "
        f"{duration(forecast.seconds)} on one core, {duration(forecast.elapsed)} with "
        f"{forecast.workers} workers, besides data and encoders"
    )
    parts = [_to_go(forecast.runs).text(width)] if forecast.runs else []
    parts.append(wrapped(summary, width))
    if forecast.prospects:
        parts.append(prospects_table(forecast.prospects).text(width))
        parts += [wrapped(each, width) for each in (*notes(planned), *caveats(planned), EFFECTS)]
    return "\n\n".join(parts)


def _to_go(runs: Sequence[tuple[Cell, int, float]]) -> Table:
    """A row for the runs of each label: how many learn at once, and how long these take."""
    sizes = Counter(cohort for _, cohort, _ in runs)
    of_labels: dict[str, list[tuple[int, float]]] = {}
    for cell, cohort, time in runs:
        of_labels.setdefault(cell.label, []).append((sizes[cohort], time))

    def spread(show: Callable[[Any], str], values: Iterable[Any]) -> str:
        shown = dict.fromkeys(map(show, sorted(values)))
        first, last = next(iter(shown)), next(reversed(shown))
        return first if first == last else f"{first} to {last}"

    return Table(
        "",
        ("agents", "runs", "at once", "time"),
        [
            (
                label,
                str(len(each)),
                spread(str, (size for size, _ in each)),
                spread(duration, (time for _, time in each)),
            )
            for label, each in of_labels.items()
        ],
    )


def prospects_table(prospects: Sequence[Prospect]) -> Table:
    """What can be found of each claim in each primary cell."""
    return Table.of(
        "",
        prospects,
        {
            "primary cell: claim": lambda each: f"{each.cell}: {each.claim}",
            "runs": lambda each: f"{each.arms.units} and {each.arms.baseline}",
            "level": lambda each: probability(each.level),
            "least p": lambda each: probability(each.least_p),
            "power": lambda each: ", ".join(f"{100 * power:.0f} %" for power in each.power),
        },
    )
