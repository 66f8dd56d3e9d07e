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
from jbrep.report import facts
from jbrep.report.answer import answer
from jbrep.report.figures.plot import Drawing, Plot
from jbrep.report.figures.style import DARK, PAGE
from jbrep.report.returns import returns_tables
from jbrep.report.statistics import across_tasks, group_tables, verdict_tables
from jbrep.report.tables import Tables
from jbrep.report.words import notes
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
        answer=answer(tables),
        returns=returns_tables(tables),
        verdicts=verdict_tables(analysis) if analysis else [],
        how=notes(analysis.planned) if analysis else [],
        figures=[_figure(plot) for plot in Progress(plots, unit="figure", delay=1, leave=False)],
        tables=[*(_tables(analysis) if analysis else ()), *predictions],
        style=Markup(_own("page.css")),
        script=Markup(script),
        script_hash=_base64(hashlib.sha256(script.encode()).digest()),
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
