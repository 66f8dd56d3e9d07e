"""A study's summary as Markdown."""

import re
from collections.abc import Iterator, Sequence

from jbrep.report import facts
from jbrep.report.columns import are_numbers
from jbrep.report.tables import Tables
from jbrep.report.words import Answer, remark
from jbrep.stats.analysis import GroupAnalysis
from jbrep.stats.comparison import Verdict
from jbrep.stats.first_claims import CLAIMS
from jbrep.stats.summary import Rows, label_rows, margin

# what would be read as markup: an underscore within a word and a bracket without a link are not
_MARKUP = re.compile(
    r"[\\`*<|~#]|&(?=[#\w])|(?<!\w)_|_(?!\w)|!(?=\[)|\](?=[(\[:])|^[-+=>]|^\d+(?=[.)])"
)


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
    groups = tables.analysis.groups if tables.analysis else ()
    for group in groups:
        if group.comparisons:
            yield from (f"Verdicts on {escape(group.name)}:", "", *_verdicts(group), "")
            yield from (escape(f"{margin(group)}."), "")
    for answer in answers:
        yield from (f"**{escape(answer.headline)}.**", "")
        for finding in answer.findings:
            yield f"- {escape(finding.where)}: *{finding.verdict}*. {escape(finding.sentence)}"
        yield ""
    if groups:
        yield from (f"![Returns over training]({picture})", "")
    for group in groups:
        yield from (f"{escape(group.name)}, with 95 % intervals over runs:", "")
        yield from (*_table(*label_rows(group)), "")
    for title, (header, rows) in predictions:
        yield from (f"{escape(title)}:", "", *_table(header, rows), "")


def _verdicts(group: GroupAnalysis) -> list[str]:
    """A row for each representation, a column for each claim."""
    header = ("representation", *(claim.name for claim in CLAIMS))
    rows = [
        (comparison.representation, *(_short(comparison.verdict(claim)) for claim in CLAIMS))
        for comparison in group.comparisons
    ]
    return _table(header, rows)


def _short(verdict: Verdict) -> str:
    return "; ".join(filter(None, (verdict.verdict, remark(verdict))))


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---:" if numbers else "---" for numbers in are_numbers(rows)]
    lines = ([escape(cell) for cell in line] for line in (header, *rows))
    first, *others = ("| " + " | ".join(line) + " |" for line in lines)
    return [first, "| " + " | ".join(rule) + " |", *others]


def escape(text: str) -> str:
    """Text on one line in which nothing is markup."""
    return _MARKUP.sub(lambda match: _escaped(match[0]), " ".join(text.split()))


def _escaped(markup: str) -> str:
    """With a backslash before the character, or after a list's number."""
    return f"{markup}\\" if markup.isdigit() else f"\\{markup}"
