"""A study's summary as Markdown."""

import re
from collections.abc import Iterator, Sequence

from jbrep.report import facts
from jbrep.report.answer import answer
from jbrep.report.returns import returns_tables
from jbrep.report.statistics import across_tasks, comparison_table, verdict_tables
from jbrep.report.tables import Tables
from jbrep.report.words import notes
from jbrep.stats import Analysis
from jbrep.text import Table

# what would be read as markup: an underscore within a word and a bracket without a link are not
_WITHIN_A_LINE = r"[\\`*<|~#]|&(?=[#\w])|(?<!\w)_|_(?!\w)|!(?=\[)|\](?=[(\[:])"


def markdown(tables: Tables, predictions: Sequence[Table], picture: str) -> str:
    """The summary, for a README, with the path of the main figure."""
    return "\n\n".join(_parts(tables, predictions, picture)) + "\n"


def _parts(tables: Tables, predictions: Sequence[Table], picture: str) -> Iterator[str]:
    yield from (f"# {escape(tables.title)}", escape(facts.outline(tables)))
    yield from map(escape, filter(None, (facts.full_scaling(tables), facts.registered(tables))))
    for notice in facts.notices(tables):
        yield f"> {escape(notice)}"
    yield from (f"**{escape(each)}**" for each in answer(tables))
    if tables.analysis:
        yield f"![Final returns]({picture})"
        yield from map(_titled, returns_tables(tables))
        yield from _findings(tables.analysis)
        yield from map(_titled, across_tasks(tables.analysis))
    yield from map(_titled, predictions)


def _findings(analysis: Analysis) -> Iterator[str]:
    """Verdicts, then comparisons with the baseline."""
    yield from map(_titled, verdict_tables(analysis))
    if analysis.verdicts:
        yield from map(escape, notes(analysis.planned))
    for group in analysis.groups:
        if group.compared:
            yield _titled(comparison_table(group, analysis.baseline))


def _titled(table: Table) -> str:
    """A table below its title."""
    rule = ["---:" if numbers else "---" for numbers in table.numeric]
    lines = ([_in_a_line(cell) for cell in line] for line in (table.header, *table.rows))
    first, *others = ("| " + " | ".join(line) + " |" for line in lines)
    return "\n".join((escape(f"{table.title}:"), "", first, f"| {' | '.join(rule)} |", *others))


def escape(text: str) -> str:
    """Text on one line in which nothing is markup."""
    line = re.sub(r"^[-+=>]", r"\\\g<0>", _in_a_line(text))
    return re.sub(r"^\d+(?=[.)])", r"\g<0>\\", line)


def _in_a_line(text: str) -> str:
    """The same, for text that begins no line."""
    return re.sub(_WITHIN_A_LINE, r"\\\g<0>", " ".join(text.split()))
