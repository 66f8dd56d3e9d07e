"""Figures of encoders, from their evaluation."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import (
    Corruption,
    Diagnostics,
    Evaluation,
    FeatureError,
    Reconstruction,
)
from jbrep.report.figures.curves import below
from jbrep.report.figures.methods import method_plots
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.prediction import MOST, bare, heat_map, least, prediction_plots
from jbrep.report.figures.style import (
    COLUMN,
    PAGE,
    Encoders,
    draw_line,
    family,
    family_styles,
    ink,
    panel_grid,
    plain,
    reference,
)

_ERROR = ("mse", "low", "high")
_Encoders = Mapping[str, "_Decoding"]  # by label


def encoder_plots(evaluation: Evaluation) -> list[Plot]:
    """What codes predict, what encoders lose, how their latent units correlate, what methods say.

    What encoders lose is drawn of those that decode; errors against latent size and against noise
    are drawn if one of their latents is smaller than the observation.
    """
    task = evaluation.data.task
    everything = evaluation.encoders
    encoders = {label: e for label, e in everything.items() if label != FULL}
    decoding = {
        label: _Decoding(e.latent, e.reconstruction, e.corruption or ())
        for label, e in encoders.items()
        if e.reconstruction
    }
    plots = prediction_plots(task, everything)
    plots += [_error_by_feature(task, decoding)] if decoding else []
    if decoding and _sizes(decoding):
        plots += [_error_by_latent(task, decoding), _error_by_corruption(task, decoding)]
    return [*plots, _latent_correlation(task, encoders), *method_plots(task, encoders)]


class _Decoding(NamedTuple):
    """What is drawn of an encoder that decodes."""

    latent: int
    error: Reconstruction
    corruption: tuple[Corruption, ...]


def _sizes(encoders: _Encoders) -> list[int]:
    """The latent sizes that are smaller than the observation."""
    size = len(_features(encoders))
    return sorted({e.latent for e in encoders.values() if e.latent < size})


def _features(encoders: _Encoders) -> tuple[FeatureError, ...]:
    """The features, as the first of the encoders loses them."""
    return next(iter(encoders.values())).error.features


def _error_by_feature(task: str, encoders: _Encoders) -> Plot:
    """R^2 of each feature (rows) for each encoder (columns)."""
    count = len(_features(encoders))
    part = f" Of {count} features the {MOST} worst are shown; all are in the table."
    return Plot(
        "error_by_feature",
        f"{task}: reconstruction of each feature",
        "R² of each feature's reconstruction on held-out episodes."
        + (part if count > MOST else ""),
        ("encoder", "feature", "r2", "low", "high"),
        [
            (label, feature.name, *feature.r2)
            for label, e in encoders.items()
            for feature in e.error.features
        ],
        lambda: _draw_features(task, encoders),
    )


def _draw_features(task: str, encoders: _Encoders) -> Figure:
    features = _features(encoders)
    values = np.array([[f.r2.value for f in e.error.features] for e in encoders.values()], float).T
    worst = least(np.nan_to_num(values, nan=1).mean(axis=1))  # what never varies isn't the worst
    names = [features[i].name for i in worst]
    which = (
        "each feature"
        if len(names) == len(features)
        else f"the {MOST} worst of {len(features)} features"
    )
    title = f"{task}:\nreconstruction of {which}"
    return heat_map(values[worst], names, list(encoders), title)


def _error_by_latent(task: str, encoders: _Encoders) -> Plot:
    """Error against latent size, a line for each family of encoders, and PCA's."""
    return Plot(
        "error_by_latent",
        f"{task}: error against latent size",
        "Mean squared error of the reconstruction on held-out episodes, features scaled to "
        "[-1, 1]; bars: 95 % intervals over episodes. Dashed: PCA with as many components.",
        ("encoder", "latent", *_ERROR, "pca_mse"),
        [(label, e.latent, *e.error.mse, e.error.pca_mse.value) for label, e in encoders.items()],
        lambda: _draw_sizes(task, encoders),
    )


def _draw_sizes(task: str, encoders: _Encoders) -> Figure:
    figure = Figure(figsize=(COLUMN, 2.9))
    axes: Axes = figure.subplots()
    sizes = _sizes(encoders)
    families = _families(encoders)
    for name, style in family_styles(families).items():
        of_size = dict(sorted(families[name].items()))
        errors = [e.error.mse for e in of_size.values()]
        draw_line(axes, [*of_size], errors, label=plain(name), **style)
    pca = {e.latent: e.error.pca_mse.value for e in encoders.values()}
    lost = np.array([pca[size] for size in sizes], float)
    axes.plot(sizes, lost, marker="o", ms=2.5, label="PCA", **reference())
    axes.set(xlabel="latent size l", ylabel="mean squared error", yscale="log", xticks=sizes)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_title(f"{task}: error on held-out episodes")
    below(figure, [axes])
    return figure


def _error_by_corruption(task: str, encoders: _Encoders) -> Plot:
    """Error in restoring clean rows from corrupted ones, a panel for each latent size."""
    return Plot(
        "error_by_corruption",
        f"{task}: error on corrupted observations",
        "Mean squared error of clean observations reconstructed from corrupted ones, against the "
        "standard deviation of the noise. Dashed: the best linear denoiser of that size; dotted: "
        "the corrupted input itself.",
        ("encoder", "latent", "noise", *_ERROR, "linear_mse", "input_mse"),
        [
            (label, e.latent, c.noise, *c.mse, c.linear_mse.value, c.input_mse)
            for label, e in encoders.items()
            for c in e.corruption
        ],
        lambda: _draw_corruption(task, encoders),
    )


def _draw_corruption(task: str, encoders: _Encoders) -> Figure:
    sizes = _sizes(encoders)
    figure = Figure(figsize=(COLUMN if len(sizes) == 1 else PAGE, 2.6))
    panels = figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0]
    families = _families(encoders)
    for axes, size in zip(panels, sizes, strict=True):
        for name, style in family_styles(families).items():
            if size in families[name]:
                levels = families[name][size].corruption
                noise, errors = zip(*((level.noise, level.mse) for level in levels), strict=True)
                draw_line(axes, noise, errors, label=plain(name), **style)
        levels = next(e.corruption for e in encoders.values() if e.latent == size)
        sd = np.array([level.noise for level in levels])
        best = [level.linear_mse.value for level in levels]
        axes.plot(sd, best, label="best linear denoiser", **reference())
        axes.plot(sd[1:], sd[1:] ** 2, ":", color=ink(), alpha=0.65, label="corrupted input")
        axes.set(title=f"latent size {size}", xlabel="noise (standard deviation)", yscale="log")
    panels[0].set_ylabel("mean squared error")
    below(figure, panels)
    figure.suptitle(f"{task}: error on corrupted observations", size=8)
    return figure


def _latent_correlation(task: str, encoders: Encoders) -> Plot:
    """Pearson's correlation between the latent units of each encoder, a panel each."""
    return Plot(
        "latent_correlation",
        f"{task}: correlation between latent units",
        "Pearson's correlation between the latent units of each encoder, numbered from 0, on "
        "held-out episodes. The units of `full` are the features. Empty: a dead unit.",
        ("encoder", "unit", "other_unit", "correlation"),
        [
            (label, names[i], names[j], value)
            for label, e in encoders.items()
            for names in (_unit_names(e),)
            for i, row in enumerate(e.latent_units.correlation)
            for j, value in enumerate(row)
        ],
        lambda: _draw_correlation(task, encoders),
    )


def _unit_names(encoder: Diagnostics) -> list[str]:
    """Numbers of the latent units from 0; for `full`, names of the features."""
    if encoder.kind == FULL and encoder.reconstruction:
        return [feature.name for feature in encoder.reconstruction.features]
    return [str(i) for i in range(encoder.latent)]


def _draw_correlation(task: str, encoders: Encoders) -> Figure:
    across = min(3, len(encoders))
    figure, panels = panel_grid(len(encoders), (PAGE - 0.8) / max(across, 2), 0.4)
    for axes, (label, e) in zip(panels, encoders.items(), strict=True):
        values = np.array(e.latent_units.correlation, float)
        picture = axes.imshow(values, cmap="RdBu_r", vmin=-1, vmax=1)
        names = _unit_names(e)
        unit, size, angle = ("feature", 5, 90) if e.kind == FULL else ("latent unit", 6.5, 0)
        if len(names) <= MOST:  # otherwise some numbers
            axes.set_xticks(range(len(names)), names, size=size, rotation=angle)
            axes.set_yticks(range(len(names)), names, size=size)
        axes.set(title=plain(label), xlabel=unit, ylabel=unit)
        bare(axes)
    rows = -(-len(panels) // across)
    figure.colorbar(picture, ax=panels, label="correlation", shrink=0.8, aspect=15 * rows)
    figure.suptitle(f"{task}: correlation between latent units", size=8)
    return figure


def _families(encoders: _Encoders) -> dict[str, dict[int, _Decoding]]:
    """Encoders that differ in latent size only, by that size; PCA is the reference, drawn apart."""
    families: dict[str, dict[int, _Decoding]] = {}
    sizes = _sizes(encoders)
    for label, e in encoders.items():
        name = family(label, e.latent)
        if name != "pca" and e.latent in sizes:
            families.setdefault(name, {})[e.latent] = e
    return families
