"""A study's report: a page to read, a summary for a README and one for programs, figures."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jbrep.errors import InputError
from jbrep.figures import study_plots, write
from jbrep.files.storage import make_folder, write_whole
from jbrep.report import facts
from jbrep.report.page import page
from jbrep.report.tables import Tables, read_tables
from jbrep.report.words import Answer, answers
from jbrep.stats.summary import label_rows

PAGE, SUMMARY, MARKDOWN, FIGURES = "report.html", "summary.json", "summary.md", "figures"
FORMAT = "jbrep summary"
FORMAT_VERSION = 1
_MAIN_FIGURE = "representations"


def write_report(folder: Path, out: Path | None = None) -> list[Path]:
    """Write the report of the tables in a folder.

    Args:
        folder: with the tables of a study.
        out: where to write it; the same folder if not given.

    Returns:
        The page, the summaries, the folder of the figures.

    Raises:
        InputError: the folder is not of a study, its tables are damaged, or it can't be written.
    """
    tables = read_tables(folder)
    out = out or folder
    make_folder(out)
    try:
        found = answers(tables.statistics) if tables.statistics else []
        plots = study_plots(
            tables.statistics, tables.returns, tables.heuristics, tables.record["labels"]
        )
        texts = {
            PAGE: page(tables, found, plots),
            SUMMARY: json.dumps(_summary(tables, found), indent=1, allow_nan=False) + "\n",
            MARKDOWN: markdown(tables, found),
        }
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"the tables in {folder} don't fit together: {error!r}") from error
    write(plots, out / FIGURES)
    for name, text in texts.items():
        write_whole(out / name, text.encode())
    return [out / name for name in (*texts, FIGURES)]


def _summary(tables: Tables, found: Sequence[Answer]) -> dict[str, Any]:
    """For programs."""
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
            for answer in found
        },
        "numbers": {
            f"{group['task']}/{group['algorithm']}/{label['representation']}": label["numbers"]
            for group in (tables.statistics["groups"] if tables.statistics else [])
            for label in group["labels"]
        },
        "versions": record["versions"],
    }


def markdown(tables: Tables, found: Sequence[Answer]) -> str:
    """For a README."""
    lines = [f"# {tables.name}", "", facts.outline(tables), ""]
    lines += [f"> {notice}\n" for notice in facts.notices(tables)]
    for answer in found:
        lines += [f"**{answer.headline}.**", ""]
        lines += [f"- {f.where}: *{f.verdict}*. {f.sentence}" for f in answer.findings] + [""]
    if tables.statistics:
        lines += [f"![Returns over training]({FIGURES}/{_MAIN_FIGURE}.png)", ""]
        for group in tables.statistics["groups"]:
            header, rows = label_rows(group)
            lines += [f"{group['task']}, {group['algorithm']}, with 95 % intervals over runs:", ""]
            lines += [
                "| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header), *rows)
            ]
            lines.append("")
    return "\n".join(lines)
