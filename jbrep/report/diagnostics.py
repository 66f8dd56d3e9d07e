"""What a report says of diagnostics: how well each predicts the final return."""

from collections.abc import Sequence

from jbrep.evaluate.table import SCALARS
from jbrep.report.tables import Tables
from jbrep.stats.association import Association, Diagnostic, associations
from jbrep.stats.summary import Rows, shown


def of_study(tables: Tables) -> list[Association]:
    """Each headline diagnostic with the final returns; none without diagnostics or statistics."""
    if tables.analysis is None:
        return []
    known = [Diagnostic(name, each.words, each.better) for name, each in SCALARS.items()]
    return associations(tables.analysis.groups, tables.diagnostics, known, tables.analysis.seed)


def diagnostic_tables(associated: Sequence[Association]) -> list[tuple[str, Rows]]:
    """A table for each task and algorithm, with a title."""
    groups = dict.fromkeys(each.group.name for each in associated)
    header = ("diagnostic", "what it is", "rank correlation", "codes")
    return [
        (
            f"{name}: do diagnostics predict learning? Rank correlation with the final return over "
            "codes, positive where the better value goes with the higher return; 95 % bootstrap "
            "intervals over codes",
            (
                header,
                [
                    (
                        each.diagnostic.name,
                        each.diagnostic.words,
                        shown(each.correlation, ".2f"),
                        str(len(each.values)),
                    )
                    for each in associated
                    if each.group.name == name
                ],
            ),
        )
        for name in groups
    ]
