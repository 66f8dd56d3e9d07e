"""The answer of release 0.3, task by task: python tools/answer.py OUT.png FOLDER ...

Prints a table of the tasks and what agents on each representation return in the end, with the
verdict on *not worse* as it was reached by that release's rules (verdicts.csv), and draws all final
returns.
"""

import csv
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jbrep.errors import InputError
from jbrep.records.storage import write_whole
from jbrep.reporting.figures.panels import PAGE, Look, Plot, reference, styles
from jbrep.reporting.findings import Agents, Findings, Group
from jbrep.reporting.tables import read_tables
from jbrep.stats.claims import CONTRADICTED, NOT_WORSE, SUPPORTED, UNDECIDED
from jbrep.text import interval

ORDER = ("coordinates", "symmetry")  # first; the others as their names are
INSIDE = {CONTRADICTED: "white", SUPPORTED: None}  # of a mean's marker; None as the rest of it
OPEN = "lightgrey"  # where nothing is decided
MARKS = {SUPPORTED: "🟩", CONTRADICTED: "🟥", UNDECIDED: "⬜"}


class Verdict(NamedTuple):
    """A row of verdicts.csv."""

    verdict: str
    share: float  # of the baseline's gain; NaN where it has none
    boundary: float


class Judged(NamedTuple):
    """A task and the verdicts on *not worse* there, by representation."""

    group: Group
    verdicts: dict[str, Verdict]

    @property
    def labels(self) -> dict[str, Agents]:
        """Results by representation."""
        return {each.representation: each for each in self.group.agents}


def read(folder: Path) -> Judged:
    """The one task of a study.

    Raises:
        InputError: it has several, or nothing was compared; or as `read_tables`.
    """
    groups = Findings.of(read_tables(folder)).groups
    if len(groups) != 1:
        raise InputError(f"{folder} isn't a study of one task with comparisons")
    (group,) = groups
    with (folder / "verdicts.csv").open(newline="") as file:
        verdicts = {
            row["representation"]: Verdict(
                row["verdict"], float(row["estimate"] or "nan"), float(row["boundary"])
            )
            for row in csv.DictReader(file)
            if row["claim"] == NOT_WORSE.name
        }
    return Judged(group, verdicts)


def representations(studies: Iterable[Judged]) -> list[str]:
    """All of them, in the order of ORDER and then of their names."""
    every = {name for study in studies for name in study.labels}
    return [name for name in ORDER if name in every] + sorted(every - {*ORDER})


def rows(studies: Sequence[Judged]) -> Iterator[list[str]]:
    """Cells of a table, the head first: a row for each representation, a column for each task."""
    yield ["agents on", *(study.group.task for study in studies)]
    for name in representations(studies):
        yield [name, *(_cell(study, name) for study in studies)]
    played = sorted((study.group.references for study in studies), key=len, reverse=True)
    policies = dict.fromkeys(policy for each in played for policy in each)
    for policy in policies:
        returned = (study.group.references.get(policy) for study in studies)
        yield [policy, *(f"{each.value:.0f}" if each else "" for each in returned)]


def _cell(study: Judged, name: str) -> str:
    if name not in study.labels:
        return ""
    returned = interval(study.labels[name].numbers["final_return_mean"], ".0f")
    if name not in study.verdicts:
        return returned
    verdict = study.verdicts[name]
    share = "" if np.isnan(verdict.share) else f", {verdict.share:.2f}"
    return f"{returned}{share} {MARKS[verdict.verdict]}"


def draw(studies: Sequence[Judged]) -> Figure:
    """The final return of each run and their means with 95 % intervals, a panel for each task.

    A marker is filled where *not worse* is supported, white where it is contradicted, else grey.
    Dashed: the best blind baseline; dotted: what has to be kept.
    """
    names = representations(studies)
    figure = Figure(figsize=(PAGE, 0.7 + 0.22 * len(names)))
    panels = figure.subplots(1, len(studies), squeeze=False, sharey=True)[0]
    look = styles(names, first=ORDER[0])
    for axes, study in zip(panels, studies, strict=True):
        for row, name in enumerate(names):
            if name in study.labels:
                _draw_runs(axes, row, study, name, look[name])
        axes.axvline(_blind(study), **reference())
        for boundary in {_boundary(study, each) for each in study.verdicts.values()}:
            axes.axvline(boundary, **{**reference(), "linestyle": ":"})
        axes.set_title(study.group.task)
        axes.set(xlim=(-30, 1030), xticks=(0, 500, 1000), xlabel="final return")
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks(range(len(names)), names)
    panels[0].set_ylim(len(names) - 0.4, -0.6)
    return figure


def _boundary(study: Judged, verdict: Verdict) -> float:
    """The return at which the share of the gain is on the verdict's boundary."""
    baseline, blind = study.group.agents[0].numbers["final_return_mean"].value, _blind(study)
    return blind + verdict.boundary * ((baseline or 0.0) - blind)


def _blind(study: Judged) -> float:
    return study.group.ends["blind"] or 0.0


def _draw_runs(axes: Axes, row: int, study: Judged, name: str, style: Look) -> None:
    label, colour = study.labels[name], style["color"]
    finals = np.array(label.by_run["final_return"], float)
    axes.plot(finals, np.full(len(finals), row - 0.22), "|", color=colour, ms=4, alpha=0.5)
    mean = np.array(label.numbers["final_return_mean"], float)
    axes.plot(mean[1:], [row, row], color=colour, linewidth=1.6)
    verdict = study.verdicts.get(name)
    inside = INSIDE.get(verdict.verdict, OPEN) if verdict else None
    place = (mean[:1], [row], style["marker"])
    axes.plot(*place, color=colour, ms=4.5, markerfacecolor=inside or colour)


def main(out: str, *folders: str) -> None:
    studies = [read(Path(each)) for each in folders]
    head, *body = rows(studies)
    for row in (head, ["---"] * len(head), *body):
        print(f"| {' | '.join(row)} |")
    plot = Plot("answer", "", "", [], lambda _: draw(studies))
    write_whole(Path(out), plot.picture("png"))


if __name__ == "__main__":
    main(*sys.argv[1:])
