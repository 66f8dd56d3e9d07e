"""A study's summary as Markdown."""

import re
from collections.abc import Iterator, Sequence

from jbrep.report import facts
from jbrep.report.answer import answer
from jbrep.report.returns import returns_tables
from jbrep.report.statistics import across_tasks, matrix
from jbrep.report.tables import Tables
from jbrep.report.words import Answer, notes, reference_words
from jbrep.stats import Analysis
from jbrep.stats.claims import EXPLORATORY
from jbrep.text import Table

# what would be read as markup: an underscore within a word and a bracket without a link are not
_WITHIN_A_LINE = r"[\\`*<|~#]|&(?=[#\w])|(?<!\w)_|_(?!\w)|!(?=\[)|\](?=[(\[:])"


def markdown(
    tables: Tables, answers: Sequence[Answer], predictions: Sequence[Table], picture: str
) -> str:
    """The summary, for a README, with the path of the main figure."""
    return "\n\n".join(_parts(tables, answers, predictions, picture)) + "\n"


def _parts(
    tables: Tables, answers: Sequence[Answer], predictions: Sequence[Table], picture: str
) -> Iterator[str]:
    yield from (f"# {escape(tables.title)}", escape(facts.outline(tables)))
    yield from map(escape, filter(None, (facts.full_scaling(tables), facts.registered(tables))))
    for notice in facts.notices(tables):
        yield f"> {escape(notice)}"
    yield from (f"**{escape(each)}**" for each in answer(tables))
    if tables.analysis:
        yield f"![Final returns]({picture})"
        yield from map(_titled, returns_tables(tables))
        yield from _findings(tables.analysis, answers)
        yield from map(_titled, across_tasks(tables.analysis))
    yield from map(_titled, predictions)


def _findings(analysis: Analysis, answers: Sequence[Answer]) -> Iterator[str]:
    """Verdicts as tables, then in sentences."""
    for group in analysis.groups:
        if group.compared:
            title = f"{group.name}, compared with {analysis.baseline}"
            yield _titled(matrix(group, analysis.planned)._replace(title=title))
            yield escape(f"Gains are counted over {reference_words(group)}.")
    if not any(group.is_judged for group in analysis.groups):
        return
    yield from map(escape, notes(analysis.planned))
    for each in answers:
        estimated = f"{each.claim.name!r} is estimated by: {each.claim.estimand}."
        yield f"**{escape(each.headline)}.** {escape(estimated)}"
        yield "\n".join(
            f"- {escape(finding.where)}: *{finding.verdict}*. {escape(finding.sentence)}"
            for finding in each.findings
            if finding.verdict != EXPLORATORY
        )


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
