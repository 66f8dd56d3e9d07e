"""Figures, drawn from the tables that the other stages write."""

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jbrep.dataset.storage import write_whole
from jbrep.evaluate.evaluation import FULL

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_STYLE: Any = {
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=_COLOURS),  # Okabe and Ito's, for the colour-blind too
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "figure.constrained_layout.use": True,
    "font.size": 8,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "savefig.dpi": 160,
}
_MARKERS = "osD^vPX"
_REFERENCE: Any = {"color": "0.4", "linestyle": "--", "linewidth": 1.2}


def encoder_figures(evaluation: dict[str, Any], folder: Path) -> list[Path]:
    """Draw an evaluation: error by feature, error against latent size, error against corruption.

    The last two need an encoder whose latent is smaller than the observation.

    Args:
        evaluation: what jbrep.evaluate.evaluate returned, or its JSON.
        folder: where to write the pictures.

    Returns:
        The files.

    Raises:
        InputError: they can't be written.
    """
    drawings = {"error_by_feature": _error_by_feature}
    if _sizes(_encoders(evaluation)):
        drawings |= {
            "error_by_latent": _error_by_latent,
            "error_by_corruption": _error_by_corruption,
        }
    files = []
    with mpl.rc_context(_STYLE):
        for name, draw in drawings.items():
            picture = io.BytesIO()
            draw(evaluation).savefig(picture)
            files.append(folder / f"{name}.png")
            write_whole(files[-1], picture.getvalue())
    return files


def _encoders(evaluation: dict[str, Any]) -> dict[str, Any]:
    """By label, in which a dollar sign doesn't begin a formula."""
    found = evaluation["encoders"].items()
    return {label.replace("$", r"\$"): e for label, e in found if label != FULL}


def _sizes(encoders: dict[str, Any]) -> list[int]:
    """The latent sizes that are smaller than the observation."""
    size = len(next(iter(encoders.values()))["reconstruction"]["features"])
    return sorted({e["latent"] for e in encoders.values() if e["latent"] < size})


def _error_by_feature(evaluation: dict[str, Any]) -> Figure:
    """R^2 of each feature (rows) by encoder (columns)."""
    encoders = _encoders(evaluation)
    features = next(iter(encoders.values()))["reconstruction"]["features"]
    values = np.array(
        [[f["r2"][0] for f in e["reconstruction"]["features"]] for e in encoders.values()], float
    ).T
    figure = Figure(figsize=(2.6 + 0.38 * len(encoders), 1.3 + 0.2 * len(features)))
    axes: Axes = figure.subplots()
    picture = axes.imshow(values, cmap="cividis", vmin=0, vmax=1, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        colour = "black" if value > 0.6 else "white"
        shown = "-" if np.isnan(value) else "<0" if value < 0 else f"{value:.2f}"
        axes.text(column, row, shown, ha="center", va="center", color=colour, size=6)
    axes.set_yticks(range(len(features)), [f["name"] for f in features])
    axes.set_xticks(range(len(encoders)), list(encoders), rotation=60, ha="right")
    axes.grid(visible=False)
    axes.set_title(f"{evaluation['data']['task']}: what comes back of each feature")
    figure.colorbar(picture, label="R² on held-out episodes")
    return figure


def _error_by_latent(evaluation: dict[str, Any]) -> Figure:
    """Error against latent size, a line for each family of encoders, and PCA's."""
    encoders = _encoders(evaluation)
    figure = Figure(figsize=(5.2, 3))
    axes: Axes = figure.subplots()
    sizes = _sizes(encoders)
    for family, style in _styles(encoders).items():
        points = {
            size: encoders[f"{family}-{size}"]["reconstruction"]["mse"]
            for size in sizes
            if f"{family}-{size}" in encoders
        }
        _draw_errors(axes, points, label=family, **style)
    pca = {e["latent"]: e["reconstruction"]["pca_mse"][0] for e in encoders.values()}
    axes.plot(sizes, [pca[size] for size in sizes], label="PCA", **_REFERENCE)
    axes.set(xlabel="latent size l", ylabel="mean squared error", yscale="log", xticks=sizes)
    axes.set_title(f"{evaluation['data']['task']}: error on held-out episodes")
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def _error_by_corruption(evaluation: dict[str, Any]) -> Figure:
    """Error from corrupted rows to clean ones, a panel for each latent size."""
    encoders = _encoders(evaluation)
    sizes = _sizes(encoders)
    figure = Figure(figsize=(1.6 + 1.9 * len(sizes), 2.8))
    panels = figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0]
    for axes, size in zip(panels, sizes, strict=True):
        for family, style in _styles(encoders).items():
            if f"{family}-{size}" in encoders:
                levels = encoders[f"{family}-{size}"]["corruption"]
                points = {level["noise"]: level["mse"] for level in levels}
                _draw_errors(axes, points, label=family, **style)
        levels = next(e["corruption"] for e in encoders.values() if e["latent"] == size)
        noise, best = zip(
            *((level["noise"], level["linear_mse"][0]) for level in levels), strict=True
        )
        axes.plot(noise, best, label="best linear denoiser", **_REFERENCE)
        axes.plot(noise[1:], np.square(noise[1:]), ":", color="0.5", label="corrupted input")
        axes.set(title=f"l = {size}", xlabel="noise", yscale="log")
    panels[0].set_ylabel("mean squared error")
    entries = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(entries.values(), entries.keys(), loc="outside right center")
    figure.suptitle(f"{evaluation['data']['task']}: does denoising denoise?", size=9)
    return figure


def _styles(encoders: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Colour and marker of each family; PCA is the reference, drawn apart."""
    families = {label.rpartition("-")[0] for label in encoders if label[-1].isdigit()} - {"pca"}
    return {
        family: {"color": _COLOURS[i % len(_COLOURS)], "marker": _MARKERS[i % len(_MARKERS)]}
        for i, family in enumerate(sorted(families, key=lambda f: (not f.startswith("dae"), f)))
    }


def _draw_errors(axes: Axes, points: dict[Any, list[float]], **style: Any) -> None:
    """A line through values with intervals."""
    if points:
        mse, low, high = np.array(list(points.values()), float).T
        spread = np.nan_to_num((mse - low, high - mse)).clip(0)
        axes.errorbar(list(points), mse, spread, ms=3.5, lw=1.2, capsize=2, **style)
