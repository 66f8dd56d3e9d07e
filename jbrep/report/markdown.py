"""A study's summary as Markdown."""

import re
from collections.abc import Iterator, Sequence

from jbrep.report import facts
from jbrep.report.columns import are_numbers
from jbrep.report.tables import Tables
from jbrep.report.words import Answer, headline, remark
from jbrep.stats.analysis import Analysis, GroupAnalysis
from jbrep.stats.summary import Rows, across_tasks, estimate_rows, label_rows, reference_words
from jbrep.stats.verdict import EXPLORATORY, Statement, Verdict

# what would be read as markup: an underscore within a word and a bracket without a link are not
_WITHIN_A_LINE = r"[\\`*<|~#]|&(?=[#\w])|(?<!\w)_|_(?!\w)|!(?=\[)|\](?=[(\[:])"
_AT_ITS_START = r"^[-+=>]|^\d+(?=[.)])"


def markdown(
    tables: Tables, answers: Sequence[Answer], predictions: Sequence[tuple[str, Rows]], picture: str
) -> str:
    """The summary, for a README.

    Args:
        tables: of the study.
        answers: on each claim.
        predictions: tables of how well diagnostics predict learning, each with a title.
        picture: the main figure's path.
    """
    return "\n".join(_lines(tables, answers, predictions, picture))


def _lines(
    tables: Tables, answers: Sequence[Answer], predictions: Sequence[tuple[str, Rows]], picture: str
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
    for title, (header, rows) in predictions:
        yield from (f"{escape(title)}:", "", *_table(header, rows), "")


def _findings(analysis: Analysis, answers: Sequence[Answer]) -> Iterator[str]:
    """Verdicts as tables, then in sentences."""
    for group in analysis.groups:
        if group.comparisons:
            title = f"{group.name}, compared with {analysis.baseline}:"
            yield from (escape(title), "", *_compared(group, analysis.claims), "")
            yield from (escape(f"Gains are counted from {reference_words(group)}."), "")
    for note in analysis.notes:
        yield from (escape(note), "")
    for claim, answer in zip(analysis.claims, answers, strict=True):
        estimated = f"{claim.name!r} is estimated by: {claim.estimand}."
        yield from (f"**{escape(answer.headline)}.** {escape(estimated)}", "")
        judged = [each for each in answer.findings if each.verdict != EXPLORATORY]
        for finding in judged:
            yield f"- {escape(finding.where)}: *{finding.verdict}*. {escape(finding.sentence)}"
        if judged:
            yield ""


def _numbers(analysis: Analysis) -> Iterator[str]:
    for group in analysis.groups:
        yield from (f"{escape(group.name)}, with 95 % intervals over runs:", "")
        yield from (*_table(*label_rows(group)), "")
    for title, (header, rows) in across_tasks(analysis):
        yield from (f"{escape(title)}:", "", *_table(header, rows), "")


def _compared(group: GroupAnalysis, claims: Sequence[Statement]) -> list[str]:
    """A row for each representation, a column for each claim."""
    if not any(comparison.is_judged for comparison in group.comparisons):
        return _table(*estimate_rows(group, claims))
    header = ("representation", *(claim.name for claim in claims))
    rows = [
        (comparison.representation, *map(_short, comparison.verdicts))
        for comparison in group.comparisons
    ]
    return _table(header, rows)


def _short(verdict: Verdict) -> str:
    return "; ".join(filter(None, (verdict.verdict, remark(verdict))))


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---:" if numbers else "---" for numbers in are_numbers(rows)]
    lines = ([_in_a_line(cell) for cell in line] for line in (header, *rows))
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
