"""Figures of encoders, from their evaluation."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import Evaluation, FeatureError, Reconstruction
from jbrep.report.figures.curves import below
from jbrep.report.figures.methods import method_plots
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.prediction import MOST, heat_map, least, prediction_plots
from jbrep.report.figures.style import (
    COLUMN,
    draw_line,
    family,
    family_styles,
    plain,
    reference,
)

_ERROR = ("mse", "low", "high")
_Encoders = Mapping[str, "_Decoding"]  # by label


def encoder_plots(evaluation: Evaluation) -> list[Plot]:
    """What codes predict, what encoders lose, what methods say.

    What encoders lose is drawn of those that decode; errors against latent size are drawn if one of
    their latents is smaller than the observation.
    """
    task = evaluation.data.task
    everything = evaluation.encoders
    encoders = {label: e for label, e in everything.items() if label != FULL}
    decoding = {
        label: _Decoding(e.latent, e.reconstruction)
        for label, e in encoders.items()
        if e.reconstruction
    }
    plots = prediction_plots(task, everything)
    plots += [_error_by_feature(task, decoding)] if decoding else []
    if decoding and _sizes(decoding):
        plots.append(_error_by_latent(task, decoding))
    return [*plots, *method_plots(task, encoders)]


class _Decoding(NamedTuple):
    """What is drawn of an encoder that decodes."""

    latent: int
    error: Reconstruction


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


def _families(encoders: _Encoders) -> dict[str, dict[int, _Decoding]]:
    """Encoders that differ in latent size only, by that size; PCA is the reference, drawn apart."""
    families: dict[str, dict[int, _Decoding]] = {}
    sizes = _sizes(encoders)
    for label, e in encoders.items():
        name = family(label, e.latent)
        if name != "pca" and e.latent in sizes:
            families.setdefault(name, {})[e.latent] = e
    return families
