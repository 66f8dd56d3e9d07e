"""Figures of encoders, from their evaluation."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from jbrep.encoders import FULL
from jbrep.figures.curves import below
from jbrep.figures.plot import Plot
from jbrep.figures.style import COLUMN, PAGE, ink, plain, reference, styles

Encoders = Mapping[str, Any]  # of evaluation.json, by label

_ERROR = ("mse", "low", "high")


def encoder_plots(evaluation: Mapping[str, Any]) -> list[Plot]:
    """What encoders lose, how they stand noise, and how their units hang together.

    Error against size and against noise need an encoder whose latent is smaller than the
    observation.

    Args:
        evaluation: what jbrep.evaluate.evaluate returned, or its JSON.
    """
    task = evaluation["data"]["task"]
    encoders = {label: e for label, e in evaluation["encoders"].items() if label != FULL}
    plots = [_error_by_feature(task, encoders)]
    if _sizes(encoders):
        plots += [_error_by_latent(task, encoders), _error_by_corruption(task, encoders)]
    return [*plots, _latent_correlation(task, encoders)]


def _sizes(encoders: Encoders) -> list[int]:
    """The latent sizes that are smaller than the observation."""
    size = len(next(iter(encoders.values()))["reconstruction"]["features"])
    return sorted({e["latent"] for e in encoders.values() if e["latent"] < size})


def _error_by_feature(task: str, encoders: Encoders) -> Plot:
    """R^2 of each feature (rows) by encoder (columns)."""
    return Plot(
        "error_by_feature",
        f"{task}: what comes back of each feature",
        "R² of each feature's reconstruction on held-out episodes.",
        ("encoder", "feature", "r2", "low", "high"),
        [
            (label, feature["name"], *feature["r2"])
            for label, e in encoders.items()
            for feature in e["reconstruction"]["features"]
        ],
        lambda: _draw_features(task, encoders),
    )


def _draw_features(task: str, encoders: Encoders) -> Figure:
    features = next(iter(encoders.values()))["reconstruction"]["features"]
    values = np.array(
        [[f["r2"][0] for f in e["reconstruction"]["features"]] for e in encoders.values()], float
    ).T
    width = max(COLUMN, 1.7 + 0.29 * len(encoders))
    figure = Figure(figsize=(width, 1.0 + 0.16 * len(features)))
    axes: Axes = figure.subplots()
    picture = axes.imshow(values, cmap="cividis", vmin=0, vmax=1, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        colour = "black" if value > 0.6 else "white"
        shown = "-" if np.isnan(value) else "<0" if value < 0 else f"{value:.2f}"
        axes.text(column, row, shown, ha="center", va="center", color=colour, size=5)
    axes.set_yticks(range(len(features)), [f["name"] for f in features])
    axes.set_xticks(range(len(encoders)), [plain(n) for n in encoders], rotation=60, ha="right")
    _bare(axes)
    axes.set_title(f"{task}: what comes back of each feature")
    figure.colorbar(picture, label="R² on held-out episodes")
    return figure


def _bare(axes: Axes) -> None:
    """As a matrix stands best."""
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)


def _error_by_latent(task: str, encoders: Encoders) -> Plot:
    """Error against latent size, a line for each family of encoders, and PCA's."""
    return Plot(
        "error_by_latent",
        f"{task}: error against latent size",
        "Mean squared error of the reconstruction on held-out episodes, features scaled to "
        "[-1, 1]; bars: 95 % intervals over episodes. Dashed: PCA with as many components.",
        ("encoder", "latent", *_ERROR, "pca_mse"),
        [
            (label, e["latent"], *e["reconstruction"]["mse"], e["reconstruction"]["pca_mse"][0])
            for label, e in encoders.items()
        ],
        lambda: _draw_sizes(task, encoders),
    )


def _draw_sizes(task: str, encoders: Encoders) -> Figure:
    figure = Figure(figsize=(COLUMN, 2.9))
    axes: Axes = figure.subplots()
    sizes = _sizes(encoders)
    for family, style in _families(encoders).items():
        points = {
            size: encoders[f"{family}-{size}"]["reconstruction"]["mse"]
            for size in sizes
            if f"{family}-{size}" in encoders
        }
        _draw_errors(axes, points, label=plain(family), **style)
    pca = {e["latent"]: e["reconstruction"]["pca_mse"][0] for e in encoders.values()}
    axes.plot(sizes, [pca[size] for size in sizes], label="PCA", **reference())
    axes.set(xlabel="latent size l", ylabel="mean squared error", yscale="log", xticks=sizes)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_title(f"{task}: error on held-out episodes")
    below(figure, [axes])
    return figure


def _error_by_corruption(task: str, encoders: Encoders) -> Plot:
    """Error from corrupted rows to clean ones, a panel for each latent size."""
    return Plot(
        "error_by_corruption",
        f"{task}: does denoising denoise?",
        "Mean squared error from corrupted observations to the clean ones, against the standard "
        "deviation of the noise. Dashed: the best linear denoiser of that size; dotted: the "
        "corrupted input itself.",
        ("encoder", "latent", "noise", *_ERROR, "linear_mse", "input_mse"),
        [
            (label, e["latent"], c["noise"], *c["mse"], c["linear_mse"][0], c["input_mse"])
            for label, e in encoders.items()
            for c in e["corruption"]
        ],
        lambda: _draw_corruption(task, encoders),
    )


def _draw_corruption(task: str, encoders: Encoders) -> Figure:
    sizes = _sizes(encoders)
    figure = Figure(figsize=(COLUMN if len(sizes) == 1 else PAGE, 2.6))
    panels = figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0]
    for axes, size in zip(panels, sizes, strict=True):
        for family, style in _families(encoders).items():
            if f"{family}-{size}" in encoders:
                levels = encoders[f"{family}-{size}"]["corruption"]
                points = {level["noise"]: level["mse"] for level in levels}
                _draw_errors(axes, points, label=plain(family), **style)
        levels = next(e["corruption"] for e in encoders.values() if e["latent"] == size)
        noise = np.array([level["noise"] for level in levels])
        best = [level["linear_mse"][0] for level in levels]
        axes.plot(noise, best, label="best linear denoiser", **reference())
        axes.plot(noise[1:], noise[1:] ** 2, ":", color=ink(), alpha=0.65, label="corrupted input")
        axes.set(title=f"l = {size}", xlabel="noise", yscale="log")
    panels[0].set_ylabel("mean squared error")
    below(figure, panels)
    figure.suptitle(f"{task}: does denoising denoise?", size=8)
    return figure


def _latent_correlation(task: str, encoders: Encoders) -> Plot:
    """Pearson's correlation of the latent's units, a panel for each encoder."""
    return Plot(
        "latent_correlation",
        f"{task}: do units repeat each other?",
        "Pearson's correlation between the units of each latent on held-out episodes; empty: a "
        "unit that is dead.",
        ("encoder", "unit", "other_unit", "correlation"),
        [
            (label, i, j, value)
            for label, e in encoders.items()
            for i, row in enumerate(e["latent_units"]["correlation"])
            for j, value in enumerate(row)
        ],
        lambda: _draw_correlation(task, encoders),
    )


def _draw_correlation(task: str, encoders: Encoders) -> Figure:
    across = min(6, len(encoders))
    rows = -(-len(encoders) // across)
    width = COLUMN if across < 3 else PAGE
    figure = Figure(figsize=(width, 0.4 + (width - 0.5) / across * rows))
    panels = figure.subplots(rows, across, squeeze=False).ravel()
    for axes in panels[len(encoders) :]:
        axes.set_axis_off()
    for axes, (label, e) in zip(panels, encoders.items(), strict=False):
        values = np.array(e["latent_units"]["correlation"], float)
        picture = axes.imshow(values, cmap="RdBu_r", vmin=-1, vmax=1)
        axes.set_title(plain(label))
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
    figure.colorbar(picture, ax=panels.tolist(), label="correlation", shrink=0.8, aspect=30)
    figure.suptitle(f"{task}: do units repeat each other?", size=8)
    return figure


def _families(encoders: Encoders) -> dict[str, dict[str, Any]]:
    """Colour and marker of each family; PCA is the reference, drawn apart."""
    families = {label.rpartition("-")[0] for label in encoders if label[-1].isdigit()} - {"pca"}
    return styles(sorted(families, key=lambda f: (not f.startswith("dae"), f)))


def _draw_errors(axes: Axes, points: dict[Any, list[float]], **style: Any) -> None:
    """A line through values with intervals."""
    if points:
        mse, low, high = np.array(list(points.values()), float).T
        spread = np.nan_to_num((mse - low, high - mse)).clip(0)
        axes.errorbar(list(points), mse, spread, ms=3, lw=1.1, capsize=1.5, **style)
