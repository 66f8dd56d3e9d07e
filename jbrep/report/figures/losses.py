"""Losses that methods report of their own training, from their encoders' files."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jbrep.evaluate.evaluation import Diagnostics
from jbrep.report.figures.curves import below
from jbrep.report.figures.families import Encoders, line_styles
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import COLUMN, PAGE, Looks, plain, reference

LOSSES = ("train_loss", "test_loss")
_WORDS = {"lipschitz": "Lipschitz"}  # of terms


def loss_by_horizon(task: str, encoders: Encoders) -> Plot:
    """The held-out loss of models that predict, part by part."""
    return Plot(
        "loss_by_horizon",
        f"{task}: loss of forward models by steps ahead",
        "Mean squared error of what the networks that were trained beside the encoders predict, "
        "each standardised, on held-out windows. Dashed: what predicting the mean would give.",
        ("encoder", "steps", "part", "loss"),
        [
            (label, int(steps), part, loss)
            for label, e in encoders.items()
            for steps, losses in e.method["loss_by_horizon"].items()
            for part, loss in losses.items()
        ],
        lambda: _draw_loss_by_horizon(task, encoders),
    )


def _draw_loss_by_horizon(task: str, encoders: Encoders) -> Figure:
    by_horizon = [e.method["loss_by_horizon"] for e in encoders.values()]
    parts = list(
        dict.fromkeys(p for each in by_horizon for losses in each.values() for p in losses)
    )
    figure = Figure(figsize=(PAGE, 2.4))
    panels = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
    look = line_styles(encoders)
    for axes, part in zip(panels, parts, strict=True):
        axes.axhline(1, label="no prediction", **reference())
        for label, e in encoders.items():
            losses = _losses_of(e, part)
            axes.plot(list(losses), list(losses.values()), ms=3, label=plain(label), **look[label])
        axes.set(title=part, xlabel="steps ahead", ylim=(0, None))
    panels[0].set_ylabel("loss on held-out windows")
    below(figure, panels)
    figure.suptitle(plain(f"{task}: loss of forward models by steps ahead"), size=8)
    return figure


def _losses_of(encoder: Diagnostics, part: str) -> dict[str, float]:
    """A part of the loss, by horizon as text, so that horizons stand equally far apart."""
    by_horizon = encoder.method["loss_by_horizon"]
    return {steps: losses[part] for steps, losses in by_horizon.items() if part in losses}


def loss_by_term(task: str, encoders: Encoders) -> Plot:
    """The held-out loss of smooth decision processes, term by term."""
    return _by_name(
        task,
        "loss_by_term",
        "terms of the loss of smooth decision processes",
        "Terms of the loss on held-out windows, unweighted: the squared error of the standardised "
        "reward, 1 for no prediction; that of the next code; and by how much the networks are "
        "steeper than they may be.",
        {label: _terms(e.method["loss_by_term"]) for label, e in encoders.items()},
        ("term", "loss on held-out windows"),
        lambda: {name: {**look, "linestyle": ""} for name, look in line_styles(encoders).items()},
    )


def _terms(losses: Mapping[str, float]) -> dict[str, float]:
    """Losses by what the terms are called."""
    return {_WORDS.get(term, term): loss for term, loss in losses.items()}


def divergence(task: str, encoders: Encoders) -> Plot:
    """How much each unit of variational codes says."""
    units = {label: sorted(e.method["divergence"])[::-1] for label, e in encoders.items()}
    return _by_name(
        task,
        "divergence",
        "how much each unit of a variational code says",
        "Mean Kullback-Leibler divergence of each unit's posterior from the prior, on held-out "
        "rows, most first: about 0 for a unit that says nothing.",
        {label: {str(i): v for i, v in enumerate(each, 1)} for label, each in units.items()},
        ("unit", "divergence [nat]"),
        lambda: line_styles(encoders),
    )


def _by_name(
    task: str,
    name: str,
    title: str,
    caption: str,
    values: Mapping[str, Mapping[str, float]],
    axis_labels: tuple[str, str],
    looks: Looks,
) -> Plot:
    """A line for each encoder over values that have names."""
    what, quantity = axis_labels

    def draw() -> Figure:
        figure = Figure(figsize=(COLUMN, 2.3))
        axes: Axes = figure.subplots()
        look = looks()
        for label, each in values.items():
            axes.plot(list(each), list(each.values()), ms=3, label=plain(label), **look[label])
        axes.set(xlabel=what, ylabel=quantity, ylim=(0, None))
        axes.set_title(plain(f"{task}:\n{title}"))
        axes.legend()
        return figure

    rows = [(label, *each) for label, named in values.items() for each in named.items()]
    columns = ("encoder", what, quantity.partition(" ")[0])
    return Plot(name, f"{task}: {title}", caption, columns, rows, draw)


def losses(task: str, encoders: Encoders) -> Plot:
    """The loss of what was trained, on both parts of the data."""
    return Plot(
        "losses",
        f"{task}: loss in training and on held-out episodes",
        "The loss that each encoder was trained by, at its best epoch: open on the training part, "
        "filled on held-out episodes. Where they part, the network knows its data by heart. Losses "
        "of different methods can't be compared.",
        ("encoder", *LOSSES),
        [
            (label, *(encoder.method[loss] for loss in LOSSES))
            for label, encoder in encoders.items()
        ],
        lambda: _draw_losses(task, encoders),
    )


def _draw_losses(task: str, encoders: Encoders) -> Figure:
    figure = Figure(figsize=(COLUMN, 0.75 + 0.16 * len(encoders)))
    axes: Axes = figure.subplots()
    look = line_styles(encoders)
    values = np.array([[e.method[loss] for loss in LOSSES] for e in encoders.values()])
    for row, (label, (train, test)) in enumerate(zip(encoders, values, strict=True)):
        colour = look[label]["color"]
        axes.plot((train, test), (row, row), color=colour, lw=0.9)
        axes.plot(train, row, "o", ms=4.5, mfc="none", mec=colour)
        axes.plot(test, row, "o", ms=3, color=colour)
    axes.set(xscale="log" if (values > 0).all() else "linear", xlabel="loss")
    axes.set_yticks(range(len(encoders)), [plain(label) for label in encoders])
    axes.set_ylim(len(encoders) - 0.4, -0.6)
    axes.set_title(plain(f"{task}:\ntraining loss (open), held-out loss (filled)"))
    return figure
