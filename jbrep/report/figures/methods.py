"""What each method says of itself: spectra, timescales and losses, from its encoders' files."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter

from jbrep.evaluate.evaluation import KEPT, Diagnostics
from jbrep.report.figures.curves import below
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import (
    COLUMN,
    PAGE,
    Encoders,
    Looks,
    family,
    family_styles,
    ink,
    line_styles,
    panel_grid,
    plain,
    reference,
)
from jbrep.stats.bootstrap import Array

_ABOVE = 0.4  # panels, for a title [inches]
_WIDE = 10  # times the least loss, beyond which an axis is logarithmic
_LOSSES = ("train_loss", "test_loss")
_WORDS = {"lipschitz": "Lipschitz"}  # of terms


def method_plots(task: str, encoders: Encoders) -> list[Plot]:
    """A figure of each kind of number that encoders say of themselves; none of what none says."""
    drawn: dict[tuple[str, ...], Callable[[str, Encoders], Plot]] = {
        ("spectrum",): _spectrum,
        ("spectra",): _timescales,
        ("loss_by_horizon",): _loss_by_horizon,
        ("loss_by_term",): _loss_by_term,
        ("divergence",): _divergence,
        _LOSSES: _losses,
    }
    plots = []
    for keys, plot in drawn.items():
        having = {
            label: e
            for label, e in encoders.items()
            if all(e.method.get(key) is not None for key in keys)
        }
        if having:
            plots.append(plot(task, having))
    return plots


def _spectrum(task: str, encoders: Encoders) -> Plot:
    """The spectrum of each family, with the sizes of its encoders."""
    return Plot(
        "spectrum",
        f"{task}: how large a code must be",
        "Eigenvalues or singular values of each unit that the method could keep, a panel for each "
        "method; those beside which a size stands are the last that a code of this size keeps. "
        "Where the values fall to nothing, a larger code keeps no more.",
        ("encoder", "latent", "unit", "value"),
        [
            (label, e.latent, i, value)
            for label, e in encoders.items()
            for i, value in enumerate(e.method["spectrum"], 1)
        ],
        lambda: _draw_spectra(task, encoders),
    )


def _draw_spectra(task: str, encoders: Encoders) -> Figure:
    kinds: dict[str, dict[str, Diagnostics]] = {}
    for label, e in encoders.items():
        kinds.setdefault(e.kind, {})[label] = e
    figure, panels = panel_grid(len(kinds), 2.1, _ABOVE)
    look = family_styles(family(label, e.latent) for label, e in encoders.items())
    for axes, (kind, members) in zip(panels, kinds.items(), strict=True):
        sizes: dict[tuple[str, tuple[float, ...]], list[int]] = {}
        for label, e in members.items():
            curve = family(label, e.latent), tuple(e.method["spectrum"])
            sizes.setdefault(curve, []).append(e.latent - e.method.get(KEPT, 0))
        for (name, spectrum), kept in sizes.items():
            _draw_spectrum(axes, name, spectrum, kept, look[name])
        axes.set(title=plain(kind), xlabel="unit")
        axes.set_ylim(min(0, axes.get_ylim()[0]))
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        if len(sizes) > 1:
            axes.legend()
    panels[0].set_ylabel("eigenvalue or singular value")
    figure.suptitle(plain(f"{task}: how large a code must be"), size=8)
    return figure


def _draw_spectrum(
    axes: Axes, name: str, spectrum: tuple[float, ...], sizes: list[int], style: dict[str, Any]
) -> None:
    """Values in order, and a ring around the last one that a code of each size keeps."""
    units = np.arange(1, len(spectrum) + 1)
    axes.plot(units, spectrum, ms=3, lw=0.9, label=plain(name), **style)
    for size in sizes:
        if size <= len(spectrum):
            at = (size, spectrum[size - 1])
            axes.plot(*at, "o", ms=7, mfc="none", mec=style["color"], mew=0.9)
            axes.annotate(f"l = {size}", at, (4, 5), textcoords="offset points", size=6)


def _timescales(task: str, encoders: Encoders) -> Plot:
    """How long each unit remembers, against the lag that it is estimated at."""
    return Plot(
        "timescales",
        f"{task}: how slow the slow features are",
        "Time in which the autocorrelation of each unit falls to 1/e, -lag / ln(eigenvalue), "
        "estimated at each lag; darkest: the slowest. Where a line is level, the estimate doesn't "
        "depend on the lag; in the grey area it is shorter than the lag, and can't be trusted.",
        ("encoder", "lag", "unit", "eigenvalue", "steps"),
        [row for label, e in encoders.items() for row in _timescale_rows(label, e)],
        lambda: _draw_timescales(task, encoders),
    )


def _timescale_rows(label: str, encoder: Diagnostics) -> Iterator[tuple[Any, ...]]:
    for lag, spectrum in encoder.method["spectra"].items():
        steps = timescales(np.array(spectrum, float), int(lag))
        for i, (value, each) in enumerate(zip(spectrum, steps, strict=True), 1):
            yield label, int(lag), i, value, f"{each:.6g}" if np.isfinite(each) else ""


def timescales(eigenvalues: Array, lag: int) -> Array:
    """Steps in which an autocorrelation falls to 1/e; NaN for eigenvalues not between 0 and 1.

    Swope, Pitera and Suits 2004: -lag / ln(eigenvalue).

    Args:
        eigenvalues: autocorrelations after the lag, (n,).
        lag: [steps].
    """
    decays = (eigenvalues > 0) & (eigenvalues < 1)
    return np.where(decays, -lag / np.log(np.where(decays, eigenvalues, 0.5)), np.nan)


def _draw_timescales(task: str, encoders: Encoders) -> Figure:
    distinct: dict[str, Diagnostics] = {}  # codes of one family keep the same spectra
    for label, e in encoders.items():
        if all(e.method["spectra"] != other.method["spectra"] for other in distinct.values()):
            distinct[family(label, e.latent)] = e
    figure, panels = panel_grid(len(distinct), 2.4, _ABOVE)
    for axes, (name, e) in zip(panels, distinct.items(), strict=True):
        spectra = {int(lag): np.array(each) for lag, each in e.method["spectra"].items()}
        lags = np.array(sorted(spectra))
        steps = np.array([timescales(spectra[lag], lag) for lag in lags])
        for i, line in enumerate(steps.T):
            shade = 0.2 + 0.8 * (1 - i / len(steps.T))
            axes.plot(lags, line, "o-", ms=2.5, lw=0.9, color=ink(), alpha=shade)
        lowest = lags.min() / 2
        axes.fill_between(lags, lags, lowest, color=ink(), alpha=0.12, lw=0)
        axes.set(xscale="log", yscale="log", xlabel="lag [steps]", title=plain(name))
        axes.set_ylim(lowest, None)
        axes.set_xticks(lags, [str(lag) for lag in lags])
        axes.xaxis.set_minor_formatter(NullFormatter())
    panels[0].set_ylabel("timescale [steps]")
    figure.suptitle(plain(f"{task}: how slow the slow features are"), size=8)
    return figure


def _loss_by_horizon(task: str, encoders: Encoders) -> Plot:
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
    parts = dict.fromkeys(p for each in by_horizon for losses in each.values() for p in losses)
    figure = Figure(figsize=(PAGE, 2.4))
    panels = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
    look = line_styles(encoders)
    for axes, part in zip(panels, parts, strict=True):
        axes.axhline(1, label="no prediction", **reference())
        for label, e in encoders.items():
            losses = _losses_of(e, part)
            axes.plot(list(losses), list(losses.values()), ms=3, label=plain(label), **look[label])
        axes.set(title=part, xlabel="steps ahead")
    panels[0].set(ylabel="loss on held-out windows", ylim=(0, None))
    below(figure, panels)
    figure.suptitle(plain(f"{task}: loss of forward models by steps ahead"), size=8)
    return figure


def _losses_of(encoder: Diagnostics, part: str) -> dict[str, float]:
    """A part of the loss, by horizon as text, so that horizons stand equally far apart."""
    by_horizon = encoder.method["loss_by_horizon"]
    return {steps: losses[part] for steps, losses in by_horizon.items() if part in losses}


def _loss_by_term(task: str, encoders: Encoders) -> Plot:
    """The held-out loss of smooth decision processes, term by term."""
    terms = {
        label: {_WORDS.get(term, term): loss for term, loss in e.method["loss_by_term"].items()}
        for label, e in encoders.items()
    }
    return _by_name(
        task,
        "loss_by_term",
        "terms of the loss of smooth decision processes",
        "Terms of the loss on held-out windows, unweighted: the squared error of the standardised "
        "reward, 1 for no prediction; that of the next code; and by how much the networks are "
        "steeper than they may be.",
        terms,
        ("term", "loss on held-out windows"),
        lambda: {name: {**look, "linestyle": ""} for name, look in line_styles(encoders).items()},
    )


def _divergence(task: str, encoders: Encoders) -> Plot:
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


def _losses(task: str, encoders: Encoders) -> Plot:
    """The loss of what was trained, on both parts of the data."""
    return Plot(
        "losses",
        f"{task}: loss in training and on held-out episodes",
        "The loss that each encoder was trained by, at its best epoch: open on the training part, "
        "filled on held-out episodes. Where they diverge, the network overfits. Losses "
        "of different methods can't be compared.",
        ("encoder", *_LOSSES),
        [(label, *(e.method[loss] for loss in _LOSSES)) for label, e in encoders.items()],
        lambda: _draw_losses(task, encoders),
    )


def _draw_losses(task: str, encoders: Encoders) -> Figure:
    figure = Figure(figsize=(COLUMN, 0.75 + 0.16 * len(encoders)))
    axes: Axes = figure.subplots()
    look = line_styles(encoders)
    values = np.array([[e.method[loss] for loss in _LOSSES] for e in encoders.values()])
    for row, (label, (train, test)) in enumerate(zip(encoders, values, strict=True)):
        colour = look[label]["color"]
        axes.plot((train, test), (row, row), color=colour, lw=0.9)
        axes.plot(train, row, "o", ms=4.5, mfc="none", mec=colour)
        axes.plot(test, row, "o", ms=3, color=colour)
    if values.min() > 0 and values.max() > _WIDE * values.min():
        axes.set_xscale("log")
    else:
        axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_xlabel("loss")
    axes.set_yticks(range(len(encoders)), [plain(label) for label in encoders])
    axes.set_ylim(len(encoders) - 0.4, -0.6)
    axes.set_title(plain(f"{task}:\ntraining loss (open), held-out loss (filled)"))
    return figure
