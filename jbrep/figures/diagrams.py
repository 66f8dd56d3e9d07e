"""Drawings of the autoencoder and of the system around it, from the sizes that they really have."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from jbrep.figures.plot import Plot
from jbrep.figures.style import COLUMN, PAGE, ink, plain, styles

Labels = Mapping[str, Any]  # of runs.json: what the runs of each label share

_MOST = 20  # units of a layer that are drawn


def diagrams(labels: Labels) -> list[Plot]:
    """The paper's Fig. 6 and Fig. 2; nothing of a study without reduced states."""
    reduced = {name: shared for name, shared in labels.items() if shared["encoder"]["encoder"]}
    denoising = {n: s for n, s in reduced.items() if s["encoder"]["kind"] == "dae"} or reduced
    if not denoising:
        return []
    first = next(iter(denoising.values()))
    task = first["settings"]["task"]
    alike = [each for each in denoising.values() if each["settings"]["task"] == task]
    encoders = {each["encoder"]["name"]: each["encoder"] for each in alike}
    return [system(first["settings"], first["encoder"]), autoencoders(task, encoders)]


def autoencoders(task: str, encoders: Mapping[str, Any]) -> Plot:
    """The encoders of a task with their decoders, unit by unit."""
    rows = [
        (name, part, i, *layer)
        for name, encoder in encoders.items()
        for part in ("encoder", "decoder")
        for i, layer in enumerate(encoder[part])
    ]
    return Plot(
        "autoencoders",
        f"The encoders of {task}",
        "Layers with their units; agents see the latent, and the decoder only serves training and "
        f"diagnosis. Of more than {_MOST} units some are left out.",
        ("encoder", "part", "layer", "units", "activation"),
        rows,
        lambda: _draw_autoencoders(encoders),
    )


def _draw_autoencoders(encoders: Mapping[str, Any]) -> Figure:
    count = min(3, len(encoders))
    rows = -(-len(encoders) // count)
    figure = Figure(figsize=(COLUMN if count == 1 else PAGE, 2.5 * rows))
    panels = figure.subplots(rows, count, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, (name, encoder) in zip(panels, encoders.items(), strict=False):
        _draw_layers(axes, encoder)
        noise = encoder["training"].get("noise")
        corrupted = f", trained with noise N(0, {noise})" if noise else ""
        axes.set_title(plain(f"{name}{corrupted}"), loc="center")
    return figure


def _draw_layers(axes: Axes, encoder: Mapping[str, Any]) -> None:
    """A column of units for each layer, joined to the next one's."""
    sizes = [(encoder["size"], "scaled")] + encoder["encoder"] + encoder["decoder"]
    latent = len(encoder["encoder"])
    colour = styles(["encoder"])["encoder"]["color"]
    columns = [_heights(units) for units, _ in sizes]
    for x, (left, right) in enumerate(pairwise(columns)):
        lines = [((x, a), (x + 1, b)) for a in left for b in right]
        axes.add_collection(LineCollection(lines, color=ink(), linewidth=0.25, alpha=0.25))
    for x, (heights, (units, words)) in enumerate(zip(columns, sizes, strict=True)):
        shade = colour if x == latent else ink()
        axes.plot(np.full(len(heights), x), heights, "o", ms=3.6, color=shade, zorder=3)
        axes.text(x, -0.08, f"{units} {words}", ha="center", va="top", size=6.5)
    names = {0: "observation", latent: "latent", len(sizes) - 1: "reconstruction"}
    for x, name in names.items():
        axes.text(x, -0.17, name, ha="center", va="top", size=6.5, color=colour, weight="bold")
    axes.set(xlim=(-0.45, len(sizes) - 0.55), ylim=(-0.26, 1.04))


def _heights(units: int) -> Any:
    """Where a layer's units stand, around the middle."""
    shown = min(units, _MOST)
    return 0.5 + (np.arange(shown) - (shown - 1) / 2) / _MOST


def system(settings: Mapping[str, Any], encoder: Mapping[str, Any]) -> Plot:
    """Robot, observation, encoder, agent, action."""
    latent = encoder["encoder"][-1][0]
    hidden = "-".join(map(str, settings["hidden"]))
    boxes = [
        ("robot", f"{settings['task']}\nMuJoCo, 1 motor"),
        ("observation", f"{encoder['size']} features\nscaled to [-1, 1]"),
        ("encoder", f"{encoder['name']}\n{encoder['size']} to {latent}"),
        ("latent", f"{latent} numbers"),
        ("agent", f"{settings['algorithm'].upper()}\nhidden {hidden}"),
    ]
    return Plot(
        "system",
        "The system",
        "What an agent sees and does in each control step of 0.01 s.",
        ("part", "what"),
        [(name, what.replace("\n", ", ")) for name, what in [*boxes, ("action", "1 drive")]],
        lambda: _draw_system(boxes),
    )


def _draw_system(boxes: Sequence[tuple[str, str]]) -> Figure:
    figure = Figure(figsize=(PAGE, 1.45))
    axes: Axes = figure.subplots()
    axes.set_axis_off()
    axes.set(xlim=(-0.05, len(boxes) * 1.25 - 0.2), ylim=(-0.55, 1.05))
    look = styles(name for name, _ in boxes)
    for i, (name, what) in enumerate(boxes):
        x, colour = 1.25 * i, look[name]["color"]
        box = FancyBboxPatch(
            (x, 0.1), 1, 0.8, "round,pad=0,rounding_size=.08", fc="none", ec=colour
        )
        axes.add_patch(box)
        axes.text(x + 0.5, 0.76, name, ha="center", va="center", weight="bold", color=colour)
        axes.text(x + 0.5, 0.4, plain(what), ha="center", va="center", size=6.5)
        if i:
            _arrow(axes, (x - 0.25, 0.5), (x, 0.5))
    last = 1.25 * (len(boxes) - 1) + 0.5
    axes.plot([last, last, 0.5], [0.1, -0.3, -0.3], color=ink(), lw=0.8, solid_capstyle="butt")
    _arrow(axes, (0.5, -0.3), (0.5, 0.1))
    axes.text(
        (last + 0.5) / 2, -0.33, "action: 1 drive in [-1, 1]", ha="center", va="top", size=6.5
    )
    return figure


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    shape: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 7, "shrinkA": 0, "shrinkB": 0}
    axes.add_patch(FancyArrowPatch(start, end, color=ink(), lw=0.8, **shape))
