"""The page of a check: its findings for people, with pictures of the features they are about."""

import base64
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from jbrep.checking.check import Check
from jbrep.checking.findings import Finding
from jbrep.envs.description import card
from jbrep.reporting import report, views
from jbrep.reporting.figures.panels import Figure, Look, Plot, Row, column, panels, styles

_MOST = 6  # features in a picture
_STEPS = 120  # of an episode
_BARS = 40
_COURSE, _VALUES = "in an episode", "how often"


def page(check: Check) -> str:
    """One self-contained HTML page."""
    style = Path(report.__file__).with_name("page.css").read_text()
    pictures = [_picture(check, each) for each in check.findings]
    return views.render(
        "check.html.j2",
        check=check,
        findings=[*zip(check.findings, pictures, strict=True)],
        returns=check.returns_table() if check.played else None,
        facts=check.facts() if check.played else {},
        card=card(check.task),
        style=Markup(style),
    )


def _picture(check: Check, finding: Finding) -> str:
    """An SVG in base64; nothing where the finding is about no feature."""
    names = check.task.feature_names
    places = [names.index(each) for each in finding.features if each in names][:_MOST]
    if not places:
        return ""
    rows = [row for i in places for row in _rows(check, i)]
    plot = Plot(finding.kind, finding.title, finding.evidence, rows, _drawn)
    return base64.b64encode(plot.picture("svg")).decode()


def _rows(check: Check, i: int) -> Iterator[dict[str, Any]]:
    """A stretch of the episode in which a feature jumps furthest, and a histogram of it."""
    seen, name = check.seen, str(check.task.features[i])
    jump = int(np.abs(seen.after[:, i] - seen.before[:, i]).argmax())
    own = np.flatnonzero(seen.episode == seen.episode[jump])
    first = max(own[0], min(jump - _STEPS // 2, own[-1] + 1 - _STEPS))
    for number in own[own >= first][:_STEPS].tolist():
        step, value = number - int(own[0]), float(seen.before[number, i])
        yield {"feature": name, "what": _COURSE, "x": float(step), "y": value}
    counts, edges = np.histogram(seen.before[:, i], _BARS)
    for left, count in zip(edges.tolist(), counts.tolist(), strict=False):
        yield {"feature": name, "what": _VALUES, "x": left, "y": float(count)}


def _drawn(rows: Sequence[Row]) -> Figure:
    return panels(
        rows,
        mark=_mark,
        looks=styles((_COURSE, _VALUES)),
        facet=("feature", "what"),
        series="what",
        axis_labels=("", ""),
        across=2,
        height=1.3,
        finish=lambda axes, own: axes.set_xlabel("step" if own[0]["what"] == _COURSE else "value"),
    )


def _mark(axes: Axes, rows: Sequence[Row], look: Look, name: str, _: int) -> None:
    x, y = column(rows, "x"), column(rows, "y")
    if name == _COURSE:
        axes.plot(x, y, ".-", ms=2, lw=0.8, color=look["color"])
    else:
        axes.bar(x, y, width=x[1] - x[0], align="edge", color=look["color"])
