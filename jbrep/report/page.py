"""A report as one self-contained HTML page."""

import base64
import hashlib
from collections.abc import Sequence
from importlib import resources
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from jbrep.progress import Progress
from jbrep.records.tables import csv_text
from jbrep.report import facts, words
from jbrep.report.answer import answer
from jbrep.report.figures.plot import Drawing, Plot
from jbrep.report.figures.style import DARK, PAGE
from jbrep.report.returns import returns_tables
from jbrep.report.statistics import across_tasks, group_tables, matrix
from jbrep.report.tables import Tables
from jbrep.stats import Analysis
from jbrep.text import Table

_WIDEST = 1000  # of a figure [CSS pixels]
_PER_INCH = 96  # CSS pixels: on a narrow screen a figure is shown at its size on paper


def page(tables: Tables, plots: Sequence[Plot], predictions: Sequence[Table]) -> str:
    """The page; the content of the tables is shown as text and never runs."""
    script, analysis = _own("page.js"), tables.analysis
    template = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return template.from_string(_own("page.html.j2")).render(
        study=tables,
        facts=facts,
        words=words,
        answer=answer(tables),
        returns=returns_tables(tables),
        beside=_beside(analysis),
        estimates=matrix,
        how=_how(analysis) if analysis else "",
        claims=words.statements(analysis.planned) if analysis else [],
        figures=[_figure(plot) for plot in Progress(plots, unit="figure", delay=1, leave=False)],
        tables=[*(_tables(analysis) if analysis else ()), *predictions],
        style=Markup(_own("page.css")),
        script=Markup(script),
        script_hash=_base64(hashlib.sha256(script.encode()).digest()),
    )


def _beside(analysis: Analysis | None) -> str:
    """What comparisons with the baseline are called; empty where nothing can be compared."""
    compared = [group for group in (analysis.groups if analysis else ()) if group.compared]
    if not analysis or not compared:
        return ""
    return "Verdicts" if any(each.is_judged for each in compared) else f"Beside {analysis.baseline}"


def _how(analysis: Analysis) -> str:
    """How comparisons are to be read."""
    if not any(group.is_judged for group in analysis.groups):
        which = "Nothing was" if not analysis.planned.rules.primary else "None of these was"
        return f"With 95 % intervals, from four runs on. {which} registered for a verdict."
    return " ".join(
        (
            f"Each representation against {analysis.baseline}; open a cell for what it rests on. "
            "Beside a verdict stands the interval that decides; other numbers have their 95 % "
            "interval. A claim's unit of replication is the run, or the encoder where there are "
            "eight or more.",
            *words.notes(analysis.planned),
        )
    )


def _tables(analysis: Analysis) -> list[Table]:
    """Every table of every group, each with a title that names the group; those across tasks."""
    of_groups = [
        table
        if table.title.startswith(group.name)
        else table._replace(title=f"{group.name}. {table.title}")
        for group in analysis.groups
        for table in group_tables(group, analysis)
    ]
    return [*of_groups, *across_tasks(analysis)]


def _figure(plot: Plot) -> dict[str, Any]:
    return {
        "name": plot.name,
        "title": plot.title,
        "caption": plot.caption,
        "width": round(min(_WIDEST, _WIDEST * max(plot.on_paper.width, 0.62 * PAGE) / PAGE)),
        "narrowest": round(_PER_INCH * plot.on_paper.width),
        "light": _base64(plot.on_paper.picture("svg")),
        "dark": _base64(Drawing(plot.draw, DARK).picture("svg")),
        "table": _base64(csv_text(plot.columns, plot.rows).encode()),
    }


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _own(name: str) -> str:
    """A file of the page, from beside this module."""
    return resources.files(__package__).joinpath(name).read_text()
