"""A study's report: a page, figures, and summaries for READMEs and for programs."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jbrep.records.storage import make_folder, write_whole
from jbrep.report import diagnostics, facts
from jbrep.report.figures import study_plots, write
from jbrep.report.markdown import markdown
from jbrep.report.page import page
from jbrep.report.tables import Tables, read_tables
from jbrep.report.words import Answer, answers
from jbrep.stats.plain import to_plain

PAGE, SUMMARY, MARKDOWN, FIGURES = "report.html", "summary.json", "summary.md", "figures"
FORMAT = "jbrep summary"
FORMAT_VERSION = 3  # before, claims were those of the first release
_MAIN_FIGURE = "representations"


def write_report(folder: Path, out: Path | None = None) -> list[Path]:
    """Write the report of the tables in a folder.

    Args:
        folder: with the tables of a study.
        out: folder for the report; the same one if not given.

    Returns:
        The paths of the page, the summaries and the folder of the figures.

    Raises:
        InputError: the folder is not that of a study, a table is damaged, or the report can't be
            written.
    """
    tables = read_tables(folder)
    out = out or folder
    make_folder(out)
    verdicts = answers(tables.analysis) if tables.analysis else []
    associated = diagnostics.of_study(tables)
    plots = study_plots(
        tables.analysis, tables.returns, tables.references, tables.record["labels"], associated
    )
    predictions = diagnostics.diagnostic_tables(associated)
    texts = {
        PAGE: page(tables, plots, predictions),
        SUMMARY: json.dumps(_summary(tables, verdicts), indent=1, allow_nan=False) + "\n",
        MARKDOWN: markdown(tables, verdicts, predictions, f"{FIGURES}/{_MAIN_FIGURE}.png"),
    }
    write(plots, out / FIGURES)
    for name, text in texts.items():
        write_whole(out / name, text.encode())
    return [out / name for name in (*texts, FIGURES)]


def _summary(tables: Tables, verdicts: Sequence[Answer]) -> dict[str, Any]:
    """The summary for programs."""
    record = tables.record
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "study": tables.name,
        "runs": len(record["runs"]),
        "missing": list(record["missing"]),
        "failed": [row[:2] for row in facts.failed_rows(tables)],
        "left_out": record["left_out"],
        "claims": {
            answer.claim: {
                "counts": answer.counts,
                "verdicts": [finding._asdict() for finding in answer.findings],
            }
            for answer in verdicts
        },
        "numbers": {
            f"{group.task}/{group.algorithm}/{label.representation}": to_plain(label.numbers)
            for group in (tables.analysis.groups if tables.analysis else ())
            for label in group.labels
        },
        "versions": record["versions"],
    }
