"""A study's report: findings.json, and what is made from it for readers, with figures."""

import base64
import hashlib
import os
import shlex
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup

from jbrep.progress import Progress
from jbrep.records.storage import make_folder, write_whole
from jbrep.reporting import views
from jbrep.reporting.diagnostics import add_diagnostics
from jbrep.reporting.figures import Plot, study_plots, write
from jbrep.reporting.figures.panels import PAGE as WHOLE
from jbrep.reporting.findings import Findings
from jbrep.reporting.tables import Tables, read_tables
from jbrep.studies.tables import Return, check_tables, has_runs, write_tables, writing
from jbrep.text import terminal_width

FINDINGS, PAGE, MARKDOWN, FIGURES = "findings.json", "report.html", "summary.md", "figures"
_MAIN_FIGURE = "final_return.png"
_WIDEST = 1000  # of a figure on the page [CSS pixels]
_PER_INCH = 96  # CSS pixels: on a narrow screen a figure is shown at its size on paper


class Report(NamedTuple):
    """What a study found."""

    folder: Path  # that has the page, the tables and the figures
    tables: Tables  # what it is made from
    findings: Findings  # what these say
    notes: list[str]  # what the diagnostics that were given are missing
    paths: list[Path]  # of the findings, the page, the summary and the folder of the figures

    @property
    def page(self) -> Path:
        """For a browser."""
        return self.folder / PAGE

    @property
    def returns(self) -> list[Return]:
        """The return of every episode of every evaluation: rows for a data frame."""
        return self.tables.raw.returns

    def __repr__(self) -> str:
        return f"{results_text(self.findings, terminal_width())}\n\n{self.page}"


def make_report(folder: Path, out: Path | None = None, evaluations: Sequence[str] = ()) -> Report:
    """Write the tables of the runs below a folder, if there are any, and the report of the tables.

    Into `out`, or the same folder, which another process that reports there is waited for.
    Evaluations are those of `add_diagnostics`.
    """
    out, ran = out or folder, has_runs(folder)
    is_own = out.resolve() == folder.resolve()
    if ran and out != folder and not os.access(folder, os.W_OK):  # it has its tables already
        ran = False
    if not ran:
        check_tables(folder)
    make_folder(out, () if is_own else (FINDINGS,))
    changes = ran or is_own or bool(evaluations)
    written = [folder, out] if changes else [out]
    with ExitStack() as stack:
        for each in sorted({each.resolve() for each in written}):
            stack.enter_context(writing(each))
        if ran:
            write_tables(folder)
        notes = add_diagnostics(folder, evaluations) if changes else []
        tables = read_tables(folder)
        found = Findings.of(tables)
        return Report(out, tables, found, notes, write_report(found, out))


def write_report(found: Findings, out: Path) -> list[Path]:
    """Write what was found into a folder: as data, page and summary, with figures.

    Returns:
        The paths of these files and of the folder of the figures.
    """
    make_folder(out)
    plots = study_plots(found)
    write(plots, out / FIGURES)
    texts = {FINDINGS: found.text(), PAGE: page(found, plots), MARKDOWN: summary(found)}
    for name, text in texts.items():
        write_whole(out / name, text.encode())
    return [out / name for name in (*texts, FIGURES)]


def page(found: Findings, plots: Sequence[Plot]) -> str:
    """One self-contained HTML page; what tables say is shown as text and never runs."""
    script, style = (Path(__file__).with_name(f"page.{kind}").read_text() for kind in ("js", "css"))
    return views.render(
        "page.html.j2",
        found=found,
        returns=views.returns_tables(found),
        verdicts=views.verdict_tables(found),
        tables=[*views.statistics_tables(found), *views.diagnostic_tables(found)],
        runs=views.run_tables(found),
        settings=views.settings_tables(found),
        commands=commands(found),
        figures=[_figure(plot) for plot in Progress(plots, unit="figure", delay=1, leave=False)],
        style=Markup(style),
        script=Markup(script),
        script_hash=_base64(hashlib.sha256(script.encode()).digest()),
    )


def _figure(plot: Plot) -> Mapping[str, Any]:
    width = float(plot.figure.get_figwidth())
    return {
        "plot": plot,
        "width": round(min(_WIDEST, _WIDEST * max(width / WHOLE, 0.62))),
        "narrowest": round(_PER_INCH * width),
        "picture": _base64(plot.picture("svg")),
        "table": _base64(plot.csv.encode()),
    }


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def commands(found: Findings) -> Mapping[str, str]:
    """What makes a study again, by what it does."""
    versions = {name: each.partition("+")[0] for name, each in found.versions[0].items()}
    packages = shlex.join(f"{name}=={each}" for name, each in versions.items() if name != "jbrep")
    folder = shlex.quote(found.name)
    imports = "".join(f" --import {shlex.quote(module)}" for module in found.imports)
    checkout = (
        f"In a checkout of jbrep {versions['jbrep']}, with these versions (equal results also need "
        "the same kind of processor):"
    )
    steps = {checkout: f"pip install '.[learn]' {packages}"}
    if found.study:
        steps["This file, as study.toml:"] = found.study
        steps["All runs:"] = f"jbrep study study.toml --out {folder}{imports}"
    return {**steps, "This report, from the runs:": f"jbrep report {folder}"}


def summary(found: Findings) -> str:
    """The summary for a README."""
    others = (views.comparison_tables, views.aggregate_tables, views.diagnostic_tables)
    text = views.render(
        "summary.md.j2",
        found=found,
        returns=views.returns_tables(found),
        verdicts=views.verdict_tables(found),
        others=[table for tables in others for table in tables(found)],
        picture=f"{FIGURES}/{_MAIN_FIGURE}",
    )
    return text.rstrip("\n") + "\n"


def results_text(found: Findings, width: int | None = None, everything: bool = False) -> str:
    """The tables that answer, and what has to be known of them; all tables if wanted."""
    more = [*views.statistics_tables(found), *views.diagnostic_tables(found)] if everything else []
    text = views.render(
        "terminal.txt.j2",
        found=found,
        returns=views.returns_tables(found, brief=True),
        verdicts=views.verdict_tables(found, brief=True),
        runs=views.last_returns(found),
        more=more,
        width=width,
    )
    return text.strip("\n")
