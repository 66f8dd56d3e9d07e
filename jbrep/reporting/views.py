"""Findings for readers: their tables, and the templates that say the rest."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from jbrep.evaluation.evaluation import Score
from jbrep.reporting.findings import Agents, Comparison, Findings, Group, RunFound, Verdict
from jbrep.stats.scale import LOOKING
from jbrep.text import SIGNIFICANT, Table, counted, interval, number, r2_text, rounded, wrapped

Cells = Mapping[str, Callable[[Any], str]]  # of a row, by the heads of columns
_MOST_DIGITS = 9  # after the point
_LEAST_LACKING = 1e-12  # of 1, in a level: floating-point numbers tell no more of it
# what would be read as markup: an underscore within a word and a bracket without a link are not
_WITHIN_A_LINE = r"[\\`*<|~#]|&(?=[#\w])|(?<!\w)_|_(?!\w)|!(?=\[)|\](?=[(\[:])"
_UNKNOWN = Score(None)
ADVICE = "rewarded"  # the diagnostic by which encoders are recommended
_NAME: Cells = {"representation": lambda each: each.representation}


# templates


def render(template: str, **given: Any) -> str:
    """A template of this folder, filled in; on a page text shows as text and never runs."""
    found = _environment(template.endswith(".html.j2")).get_template(template)
    return found.render(say=say, notices=notices, **given)


def say(what: str, *about: Any) -> str:
    """A sentence of words.j2, by the name of its macro; nothing where there is nothing to say."""
    macro = getattr(_environment(False).get_template("words.j2").module, what)
    return " ".join(str(macro(*about)).split())


@cache
def _environment(is_page: bool) -> Environment:
    found = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=is_page,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {
        "number": number,
        "counted": counted,
        "markdown": lambda part: markdown(part) if isinstance(part, Table) else escape(part),
        "text": in_text,
    }
    return found


def in_text(part: str | Table, width: int | None) -> str:
    """A table or a sentence for a terminal."""
    return part.text(width) if isinstance(part, Table) else wrapped(part, width)


def markdown(table: Table) -> str:
    """A table below its title."""
    rule = ["---:" if numbers else "---" for numbers in table.numeric]
    lines = ([_in_a_line(cell) for cell in line] for line in (table.header, *table.rows))
    first, *others = ("| " + " | ".join(line) + " |" for line in lines)
    return "\n".join((escape(f"{table.title}:"), "", first, f"| {' | '.join(rule)} |", *others))


def escape(text: str) -> str:
    """Text on one line of Markdown in which nothing is markup."""
    line = re.sub(r"^[-+=>]", r"\\\g<0>", _in_a_line(text))
    return re.sub(r"^\d+(?=[.)])", r"\g<0>\\", line)


def _in_a_line(text: str) -> str:
    """The same, for text that begins no line."""
    return re.sub(_WITHIN_A_LINE, r"\\\g<0>", " ".join(text.split()))


# what was found


def notices(found: Findings) -> list[str]:
    """What a reader must know first: what is missing, has failed, or can't be told."""
    said = (say(what, found) for what in ("unfinished", "failures", "not_played"))
    return [*filter(None, said), *(f"No statistics: {each}." for each in found.left_out)]


def returns_tables(found: Findings, brief: bool = False) -> list[Table]:
    """Final returns, which agents learned, what they score: of each task and algorithm.

    Algorithms on one representation alone stand in one table for each task. A brief table leaves
    out what the page and the summary have besides.
    """
    alone = all(len(group.agents) == 1 for group in found.groups)
    together: dict[str, list[Group]] = {}
    for group in found.groups:
        together.setdefault(group.task if alone else group.name, []).append(group)
    return [_returns_table(name, groups, found, brief) for name, groups in together.items()]


def _returns_table(name: str, groups: Sequence[Group], found: Findings, brief: bool) -> Table:
    """A row for each agent, then for each policy that doesn't learn; no column without content."""
    first, several, form = groups[0], len(groups) > 1, return_form(groups)
    gain = f"share of gain on {found.baseline}"
    kept = {each.representation: each.numbers["share_of_gain"] for each in first.compared}
    advised = {
        name: value
        for each in found.diagnostics
        if (each.task, each.algorithm, each.diagnostic) == (first.task, first.algorithm, ADVICE)
        for name, value in zip(each.representations, each.values, strict=True)
    }
    shares = dict.fromkeys(share for g in groups for each in g.agents for share in each.shares)
    columns: Cells = {
        "failed": lambda each: str(len(each.failed) or "-"),
        "final return": _number("final_return_mean", form),
        "above baselines": lambda each: f"{each.learnt}{', rising' if each.rises else ''}",
        "score": _number("score", ".2f"),
        **(
            {f"predicted ({ADVICE})": lambda each: r2_text(advised.get(each.representation))}
            if advised
            else {}
        ),
        gain: lambda each: interval(kept.get(each.representation, _UNKNOWN), ".2f"),
        "rise at the end": _number("rise", form),
        **{f"share of {n}": partial(_share, n) for n in shares},
    }
    if brief:
        columns = {n: cell for n, cell in columns.items() if n not in (gain, "rise at the end")}
    rows = [
        (g.algorithm if several else each.representation, *(c(each) for c in columns.values()))
        for g in groups
        for each in g.agents
    ]
    for policy, mean in first.references.items():
        cells = dict.fromkeys(columns, "-") | {"final return": interval(mean, form)}
        rows.append((policy, *cells.values()))
    header = ("algorithm" if several else "agents on", *columns)
    return without_nothing(Table(say("returns", name, groups, found, form, brief), header, rows))


def _share(name: str, each: Agents | RunFound) -> str:
    share = each.shares.get(name)
    return number(share, ".2f") if not isinstance(share, tuple) else interval(share, ".2f")


def verdict_tables(found: Findings, brief: bool = False) -> list[Table]:
    """What was registered: a table for each task and algorithm."""
    tables = []
    for task, algorithm in dict.fromkeys((v.task, v.algorithm) for v in found.verdicts):
        rows = [verdict_cells(verdict) for verdict in found.verdicts_of(task, algorithm)]
        if brief:
            rows = [{n: row[n] for n in ("claim", "verdict", "estimate", "score")} for row in rows]
        title = f"{task}, {algorithm}, registered claims"
        tables.append(Table(title, tuple(rows[0]), [tuple(row.values()) for row in rows]))
    return tables


def verdict_cells(verdict: Verdict) -> dict[str, str]:
    """What a verdict rests on, by the heads of columns."""
    tested = verdict.estimate if verdict.level is None else verdict.interval
    width = verdict.width or math.nan
    score = [None if end is None or math.isnan(width) else end / width for end in tested]
    return {
        "claim": verdict.sentence,
        "verdict": say("verdict", verdict),
        "estimate": interval(tested),
        "score": interval(score, ".2f"),
        "why": verdict.reason or "-",
        "level": "-" if verdict.level is None else _level(verdict.level),
        "boundary": number(verdict.boundary),
        "p": probability(verdict.p),
        "units": counted(verdict.units, "encoder" if verdict.by_encoder else "run"),
    }


def _level(error: float) -> str:
    """The level of an interval: two digits at least of what it lacks of 100 %."""
    lacking = max(error, _LEAST_LACKING)
    digits = max(4, 1 - math.floor(math.log10(lacking)))
    return f"{100 * (1 - lacking):.{digits}g} %"


def probability(p: float | None) -> str:
    """A probability to three digits; a dash where there is none."""
    return "<0.001" if p is not None and p < 0.001 else number(p, ".3f")


def statistics_tables(found: Findings) -> list[Table]:
    """All tables of numbers, by task and algorithm, then across tasks."""
    tables: list[Table] = []
    for group in found.groups:
        tables.append(group_table(group))
        tables += [_comparison_table(group, found.baseline)] if group.compared else []
    return [*tables, *aggregate_tables(found)]


def group_table(group: Group) -> Table:
    """Every number that is known of each representation; of steps to a return, their median."""
    forms = {"steps": ",.0f", "reached": ".2f", "score": ".2f", "encoder": SIGNIFICANT}
    usual = return_form([group], more=1)
    columns: dict[str, Callable[[Agents], str]] = {
        "runs": lambda each: str(len(each.seeds)),
        "failed": lambda each: str(len(each.failed)),
        "encoders": lambda each: str(each.encoders),
    }
    for name in group.agents[0].numbers:
        columns[name.replace("_", " ")] = _number(name, forms.get(name.split("_")[0], usual))
    cut = f"; the comparison {group.cut}" if group.cut else ""
    title = f"{group.name}: over {group.grid[-1]:,.0f} steps; 95 % intervals over runs{cut}"
    return without_nothing(Table.of(title, group.agents, {**_NAME, **columns}))


def without_nothing(table: Table) -> Table:
    """The table without columns in which no cell says anything."""
    said = [
        i for i in range(len(table.header)) if any(row[i] not in ("-", "0") for row in table.rows)
    ]
    rows = [tuple(row[i] for i in said) for row in table.rows]
    return Table(table.title, tuple(table.header[i] for i in said), rows)


def _number(name: str, form: str = SIGNIFICANT) -> Callable[[Agents | Comparison], str]:
    return lambda each: interval(each.numbers[name], form)


def comparison_tables(found: Findings) -> list[Table]:
    """A row for each comparison with the baseline; differences are taken seed by seed."""
    return [_comparison_table(each, found.baseline) for each in found.groups if each.compared]


def _comparison_table(group: Group, baseline: str) -> Table:
    form = return_form([group])
    columns: Cells = {
        **_NAME,
        "final return": _number("final_return_difference", form),
        "score": _number("score_difference", ".2f"),
        "share of gain": _number("share_of_gain", ".2f"),
        "mean return": _number("mean_return_difference", form),
        "steps later at half of the gain": _number("steps_later", ",.0f"),
        "P(improvement)": _number("probability_of_improvement", ".2f"),
        "spread of curves": _number("spread_ratio", ".2f"),
        "variance ratio": _number("variance_ratio"),
        "Brown-Forsythe p": lambda each: probability(each.brown_forsythe_p),
    }
    return Table.of(f"{group.name}, compared with {baseline}", group.compared, columns)


def aggregate_tables(found: Findings) -> list[Table]:
    """Scores across tasks, a table for each algorithm."""
    columns: Cells = {
        **_NAME,
        "runs": lambda each: f"{each.runs} of each",
        "IQM": lambda each: interval(each.iqm, ".2f"),
        "optimality gap": lambda each: interval(each.optimality_gap, ".2f"),
    }
    tables = []
    for algorithm in dict.fromkeys(each.algorithm for each in found.aggregates):
        own = [each for each in found.aggregates if each.algorithm == algorithm]
        over = f"{algorithm} across {', '.join(own[0].tasks)}: scores"
        tables.append(Table.of(f"{over}; 95 % intervals over runs within tasks", own, columns))
    return tables


def diagnostic_tables(found: Findings) -> list[Table]:
    """How well diagnostics predict learning, a table for each task and algorithm."""
    columns: Cells = {
        "diagnostic": lambda each: each.diagnostic,
        "what it is": lambda each: each.words,
        "rank correlation": lambda each: interval(each.correlation, ".2f"),
        "encoders": lambda each: str(len(each.values)),
        "families": lambda each: str(len({*each.families})),
    }
    tables = []
    for key in dict.fromkeys((each.task, each.algorithm) for each in found.diagnostics):
        own = [each for each in found.diagnostics if (each.task, each.algorithm) == key]
        tables.append(Table.of(say("diagnostics", ", ".join(key)), own, columns))
    return tables


def return_form(groups: Sequence[Group], more: int = 0) -> str:
    """A format for returns: three digits of the range of final returns, or more of them.

    Those of blind baselines are among them. Of a range that is small beside the returns
    themselves, as many as give these five.
    """
    returns = [
        each for g in groups for agents in g.agents for each in agents.by_run["final_return"]
    ]
    returns += [mean.value for g in groups for n, mean in g.references.items() if n != LOOKING]
    known = np.array([each for each in returns if each is not None])
    width = max(np.ptp(known), np.abs(known).max() / 100) if len(known) else 0.0
    return f",.{np.clip(2 - math.floor(math.log10(width or 1.0)), 0, _MOST_DIGITS) + more}f"


# how it ran


def run_tables(found: Findings) -> list[Table]:
    """All runs: those that failed, those that go on, those that have ended."""
    reasons: Cells = {
        "run": lambda run: run.label,
        "seed": lambda run: str(run.seed),
        "at step": lambda run: f"{run.steps:,}",
        "reason": lambda run: run.reason or "-",
    }
    failed = Table.of("Failed", found.failed, reasons)
    unfinished = [(name, f"{steps:,}") for name, steps in found.missing.items()]
    every = failed, Table("Unfinished", ("run", "steps done"), unfinished), last_returns(found)
    return [table for table in every if table.rows]


def last_returns(found: Findings) -> Table:
    """A row for each finished or failed run, with its last evaluation."""
    names = dict.fromkeys(name for run in found.runs for name in run.shares)
    columns: Cells = {
        "run": lambda run: run.label,
        "seed": lambda run: str(run.seed),
        "status": lambda run: run.status,
        "steps": lambda run: f"{run.steps:,}",
        "final return": lambda run: rounded(np.mean(run.returns))[0] if run.returns else "-",
        **{f"share of {name}": partial(_share, name) for name in names},
        "minutes": lambda run: f"{run.minutes:.1f}",
    }
    title = "Runs that have ended; final returns are means over the last evaluation"
    return Table.of(title, found.runs, columns)


def settings_tables(found: Findings) -> list[Table]:
    """Packages, encoders, and the settings that agents share."""
    packages = {
        name: ", ".join(dict.fromkeys(each[name] for each in found.versions if name in each))
        for name in dict.fromkeys(name for each in found.versions for name in each)
    }
    encoders = [tuple(map(_shown, encoder.values())) for encoder in found.encoders]
    names = dict.fromkeys(name for settings in found.settings.values() for name in settings)
    of_agents = [
        (name, *(_shown(settings.get(name)) for settings in found.settings.values()))
        for name in names
    ]
    return [
        Table("Packages", ("package", "version"), [*packages.items()]),
        Table("Encoders", tuple(found.encoders[0]), encoders),
        Table("Agents", ("setting", *found.settings), of_agents),
    ]


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "-"
    if isinstance(value, str) and re.fullmatch(r"[0-9a-f]{64}", value):
        return value[:12]
    return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
