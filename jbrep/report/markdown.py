"""A study's summary as Markdown."""

import re
from collections.abc import Iterator, Sequence

from jbrep.report import facts
from jbrep.report.statistics import across_tasks, label_table, matrix
from jbrep.report.tables import Tables
from jbrep.report.words import Answer, headline, notes, reference_words
from jbrep.stats import Analysis
from jbrep.stats.claims import EXPLORATORY
from jbrep.text import Table

# what would be read as markup: an underscore within a word and a bracket without a link are not
_WITHIN_A_LINE = r"[\\`*<|~#]|&(?=[#\w])|(?<!\w)_|_(?!\w)|!(?=\[)|\](?=[(\[:])"
_AT_ITS_START = r"^[-+=>]|^\d+(?=[.)])"


def markdown(
    tables: Tables, answers: Sequence[Answer], predictions: Sequence[Table], picture: str
) -> str:
    """The summary, for a README.

    Args:
        tables: of the study.
        answers: on each claim.
        predictions: how well diagnostics predict learning.
        picture: the main figure's path.
    """
    return "\n".join(_lines(tables, answers, predictions, picture))


def _lines(
    tables: Tables, answers: Sequence[Answer], predictions: Sequence[Table], picture: str
) -> Iterator[str]:
    yield from (f"# {escape(tables.name)}", "", escape(facts.outline(tables)), "")
    if registered := facts.registered(tables):
        yield from (escape(registered), "")
    for notice in facts.notices(tables):
        yield from (f"> {escape(notice)}", "")
    yield from (f"**{escape(headline(tables.analysis))}**", "")
    if tables.analysis:
        yield from _findings(tables.analysis, answers)
        yield from (f"![Returns over training]({picture})", "")
        yield from _numbers(tables.analysis)
    for table in predictions:
        yield from (f"{escape(table.title)}:", "", *_rendered(table), "")


def _findings(analysis: Analysis, answers: Sequence[Answer]) -> Iterator[str]:
    """Verdicts as tables, then in sentences."""
    for group in analysis.groups:
        if group.comparisons:
            title = f"{group.name}, compared with {analysis.baseline}:"
            yield from (escape(title), "", *_rendered(matrix(group, analysis.planned)), "")
            yield from (escape(f"Gains are counted from {reference_words(group)}."), "")
    for note in notes(analysis.planned):
        yield from (escape(note), "")
    for answer in answers:
        estimated = f"{answer.claim!r} is estimated by: {answer.estimand}."
        yield from (f"**{escape(answer.headline)}.** {escape(estimated)}", "")
        judged = [each for each in answer.findings if each.verdict != EXPLORATORY]
        for finding in judged:
            yield f"- {escape(finding.where)}: *{finding.verdict}*. {escape(finding.sentence)}"
        if judged:
            yield ""


def _numbers(analysis: Analysis) -> Iterator[str]:
    for group in analysis.groups:
        yield from (f"{escape(group.name)}, with 95 % intervals over runs:", "")
        yield from (*_rendered(label_table(group)), "")
    for table in across_tasks(analysis):
        yield from (f"{escape(table.title)}:", "", *_rendered(table), "")


def _rendered(table: Table) -> list[str]:
    """The lines of a table, without its title."""
    rule = ["---:" if numbers else "---" for numbers in table.numeric]
    lines = ([_in_a_line(cell) for cell in line] for line in (table.header, *table.rows))
    first, *others = ("| " + " | ".join(line) + " |" for line in lines)
    return [first, "| " + " | ".join(rule) + " |", *others]


def escape(text: str) -> str:
    """Text on one line in which nothing is markup."""
    return re.sub(_AT_ITS_START, lambda match: _escaped(match[0]), _in_a_line(text))


def _in_a_line(text: str) -> str:
    """The same, for text that begins no line."""
    return re.sub(_WITHIN_A_LINE, r"\\\g<0>", " ".join(text.split()))


def _escaped(markup: str) -> str:
    """With a backslash before the character, or after a list's number."""
    return f"{markup}\\" if markup.isdigit() else f"\\{markup}"
