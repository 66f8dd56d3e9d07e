"""The page of a check: its findings for people, with pictures of the features they are about."""

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from jbrep.checking.check import Check
from jbrep.checking.features import Finding
from jbrep.envs.card import card
from jbrep.reporting import report, views
from jbrep.reporting.figures.panels import PAGE, Plot, plain

_MOST, _STEPS, _BINS = 6, 120, 40  # features in a picture; steps of an episode; of a histogram


def page(check: Check) -> str:
    """One self-contained HTML page."""
    style = Path(report.__file__).with_name("page.css").read_text()
    pictures = [_picture(check, each) for each in check.findings]
    return views.render(
        "check.html.j2",
        check=check,
        findings=[*zip(check.findings, pictures, strict=True)],
        card=card(check.seen.task),
        style=Markup(style),
    )


def _picture(check: Check, finding: Finding) -> str:
    """An SVG in base64; nothing where the finding is about no feature."""
    names = check.seen.task.feature_names
    places = [names.index(each) for each in finding.features if each in names][:_MOST]
    if not places:
        return ""
    plot = Plot(finding.kind, finding.title, finding.evidence, [], lambda _: _drawn(check, places))
    return base64.b64encode(plot.picture("svg")).decode()


def _drawn(check: Check, places: Sequence[int]) -> Figure:
    """Of each feature a stretch of the episode in which it jumps furthest, and a histogram."""
    seen, figure = check.seen, Figure(figsize=(PAGE, 0.4 + 1.2 * len(places)))
    grid = figure.subplots(len(places), 2, squeeze=False)
    for i, (course, values) in zip(places, grid, strict=True):
        jump = int(np.abs(seen.after[:, i] - seen.before[:, i]).argmax())
        own = np.flatnonzero(seen.episode == seen.episode[jump])
        shown = own[own >= min(jump - _STEPS // 2, own[-1] + 1 - _STEPS)][:_STEPS]
        course.plot(seen.step[shown], seen.before[shown, i], ".-", ms=2, lw=0.8)
        course.set_title(plain(str(seen.task.features[i])))
        values.hist(seen.before[:, i], _BINS)
    for axes, what in zip(grid[-1], ("step of an episode", "value"), strict=True):
        axes.set_xlabel(what)
    return figure
