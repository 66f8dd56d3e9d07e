"""A study's report: a page, figures, and summaries for READMEs and for programs."""

import base64
import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.encoders.base import OWN
from jbrep.evaluate.table import SCALARS
from jbrep.records.lock import exclusive
from jbrep.records.storage import exists, make_folder, write_whole
from jbrep.report import facts
from jbrep.report.answer import answer
from jbrep.report.figures import study_plots, write
from jbrep.report.markdown import markdown
from jbrep.report.page import page
from jbrep.report.returns import returns_tables
from jbrep.report.statistics import association_tables, results_text
from jbrep.report.tables import Tables, check_tables, read_tables
from jbrep.report.words import notes
from jbrep.stats import Analysis
from jbrep.stats.analysis import to_plain
from jbrep.stats.association import Association, Diagnostic, associations
from jbrep.study.results import has_runs, write_tables
from jbrep.study.tables import Return, add_diagnostics
from jbrep.text import html, terminal_width

PAGE, SUMMARY, MARKDOWN, FIGURES = "report.html", "summary.json", "summary.md", "figures"
STATISTICS = "statistics.json"
_MAIN_FIGURE = "final_return"
_MOST_SECONDS = 600.0  # to wait for another process's report


class Report(NamedTuple):
    """What a study found.

    Attributes:
        folder: that has the page, the tables and the figures.
        tables: what these say.
        notes: what the diagnostics that were given are missing, and what couldn't be played.
        paths: of the page, the summaries and the folder of the figures.
    """

    folder: Path
    tables: Tables
    notes: list[str]
    paths: list[Path]

    @property
    def page(self) -> Path:
        """For a browser."""
        return self.folder / PAGE

    @property
    def returns(self) -> list[Return]:
        """The return of every episode of every evaluation: rows for a data frame."""
        return self.tables.returns

    def __repr__(self) -> str:
        return f"{results_text(self.tables, terminal_width())}\n\n{self.page}"

    def _repr_html_(self) -> str:
        picture = self.folder / FIGURES / f"{_MAIN_FIGURE}.png"
        if not (self.tables.analysis and exists(picture)):
            return html(repr(self))
        content = base64.b64encode(picture.read_bytes()).decode()
        shown = f'<img width="700" src="data:image/png;base64,{content}">'
        told = html(*answer(self.tables))
        return told + shown + html(*returns_tables(self.tables), str(self.page))


def make_report(
    folder: Path,
    out: Path | None = None,
    evaluations: Sequence[str] = (),
) -> Report:
    """Write the tables of the runs below a folder, if there are any, and the report of the tables.

    Another process that reports of the same folder is waited for.

    Args:
        folder: with runs, of a study or not, or with the tables of a study alone.
        out: folder for the report; the same one if not given.
        evaluations: as for `jbrep.study.tables.add_diagnostics`.
    """
    out, ran = out or folder, has_runs(folder)
    if not ran:
        check_tables(folder)
    make_folder(out, () if out.resolve() == folder.resolve() else (SUMMARY,))
    written = [folder, out] if ran or evaluations else [out]
    with ExitStack() as stack:
        for each in sorted({each.resolve() for each in written}):
            stack.enter_context(exclusive(each / PAGE, beside=True, wait=_MOST_SECONDS))
        if ran:
            write_tables(folder)
        notes = add_diagnostics(folder, evaluations)
        tables = read_tables(folder)
        notes += _without_references(tables)
        return Report(out, tables, notes, write_report(tables, out))


def _without_references(tables: Tables) -> list[str]:
    """A line where nothing is known of policies that don't look, so that little can be said."""
    if unknown := sorted({*tables.record.tasks} - {*tables.references}):
        return [
            f"no policy could be played on {', '.join(unknown)}, to compare agents with: if a "
            "module of yours makes it, add --import MODULE"
        ]
    return []


def write_report(tables: Tables, out: Path) -> list[Path]:
    """Write the report of a study's tables.

    Args:
        tables: of the study, as `jbrep.report.tables.read_tables` gives them.
        out: a folder for it.

    Returns:
        The paths of the page, the summaries and the folder of the figures.
    """
    make_folder(out)
    associated = _associated(tables)
    plots = study_plots(
        tables.analysis, tables.returns, tables.references, tables.record.labels, associated
    )
    predictions = association_tables(associated)
    texts = {
        PAGE: page(tables, plots, predictions),
        SUMMARY: _json(_summary(tables), indent=1),
        MARKDOWN: markdown(tables, predictions, f"{FIGURES}/{_MAIN_FIGURE}.png"),
    }
    write(plots, out / FIGURES)
    if tables.analysis:
        texts[STATISTICS] = _json(statistics(tables.analysis), indent=2)
    else:
        (out / STATISTICS).unlink(missing_ok=True)  # of fewer runs
    for name, text in texts.items():
        write_whole(out / name, text.encode())
    return [out / name for name in (*texts, FIGURES)]


def _json(contents: dict[str, Any], indent: int) -> str:
    return json.dumps(contents, indent=indent, allow_nan=False) + "\n"


def _associated(tables: Tables) -> list[Association]:
    """Each headline diagnostic with the final returns; none without diagnostics or statistics."""
    if tables.analysis is None:
        return []
    known = [Diagnostic(name, each.words, each.better) for name, each in SCALARS.items()]
    families = {}
    for label in tables.record.labels.values():
        task, name = label.settings.task, label.settings.representation
        kind = label.encoder.kind
        families[task, name] = name if kind == OWN else kind
    analysis = tables.analysis
    return associations(analysis.groups, tables.diagnostics, known, families, analysis.seed)


def statistics(analysis: Analysis) -> dict[str, Any]:
    """All statistics for programs; an interval is [value, low, high], None if not finite."""
    return {
        "format": "jbrep statistics",
        "format_version": 5,
        "baseline": analysis.baseline,
        "seed": analysis.seed,
        "notes": notes(analysis.planned),
        "groups": to_plain(analysis.groups),
        "aggregates": to_plain(analysis.aggregates),
    }


def _summary(tables: Tables) -> dict[str, Any]:
    """The summary for programs."""
    record = tables.record
    return {
        "format": "jbrep summary",
        "format_version": 4,
        "study": tables.name,
        "runs": len(record.runs),
        "missing": list(record.missing),
        "failed": [row[:2] for row in facts.failed_runs(tables).rows],
        "left_out": tables.left_out,
        "verdicts": to_plain(tables.analysis.verdicts) if tables.analysis else [],
        "numbers": {
            f"{group.task}/{group.algorithm}/{label.representation}": to_plain(label.numbers)
            for group in (tables.analysis.groups if tables.analysis else ())
            for label in group.labels
        },
        "versions": record.versions,
    }
