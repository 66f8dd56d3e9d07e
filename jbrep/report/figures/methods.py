"""What each method says of itself: spectra and timescales, from its encoders' files."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter

from jbrep.evaluate.evaluation import Diagnostics
from jbrep.report.figures.families import Encoders, family, family_styles
from jbrep.report.figures.losses import LOSSES, divergence, loss_by_horizon, loss_by_term, losses
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import ink, panel_grid, plain
from jbrep.stats.bootstrap import Array

_ABOVE = 0.4  # panels, for a title [inches]


def method_plots(task: str, encoders: Encoders) -> list[Plot]:
    """A figure of each kind of number that encoders say of themselves; none of what none says.

    Args:
        task: the name.
        encoders: of an evaluation, by label.
    """
    drawn: dict[tuple[str, ...], Callable[[str, Encoders], Plot]] = {
        ("spectrum",): _spectrum,
        ("spectra",): _timescales,
        ("loss_by_horizon",): loss_by_horizon,
        ("loss_by_term",): loss_by_term,
        ("divergence",): divergence,
        LOSSES: losses,
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
            sizes.setdefault(curve, []).append(e.latent)
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
