"""Drawings of the autoencoder and of the system around it, to their actual sizes."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from jbrep.coordinates import OBSERVATION
from jbrep.dataset.scaling import EXTREMA
from jbrep.envs.task import Task
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import PAGE, Looks, ink, panel_grid, plain
from jbrep.study.record import EncoderFacts, Label, ShownFacts
from jbrep.text import counted

_MOST = 20  # units of a layer that are drawn
_TITLE = 45  # characters on a line above a panel
_BOX = 19  # characters on a line of a box


def diagrams(labels: Mapping[str, Label], looks: Looks) -> list[Plot]:
    """The paper's Fig. 6 and Fig. 2; nothing of a study without reduced states."""
    reduced = [shared for shared in labels.values() if shared.encoder.encoder]
    drawn = [shared for shared in reduced if shared.encoder.kind == "dae"] or reduced
    if not drawn:
        return []
    task = drawn[0].settings.task
    of_task = [shared for shared in drawn if shared.settings.task == task]
    by_representation = {each.settings.representation: each.encoder for each in of_task}
    return [system(drawn[0], looks), autoencoders(task, by_representation, looks)]


def autoencoders(task: str, encoders: Mapping[str, EncoderFacts], looks: Looks) -> Plot:
    """The encoders of a task with their decoders, unit by unit; by representation."""
    rows = [
        (name, part, i, *layer)
        for name, encoder in encoders.items()
        for part, layers in (("encoder", encoder.encoder), ("decoder", encoder.decoder))
        for i, layer in enumerate(layers)
    ]
    return Plot(
        "autoencoders",
        f"The encoders of {task}",
        "Layers with their units; agents see the latent, and the decoder only serves training and "
        f"diagnosis. Of larger layers {_MOST} units are drawn.",
        ("encoder", "part", "layer", "units", "activation"),
        rows,
        lambda: _draw_autoencoders(encoders, looks),
    )


def _draw_autoencoders(encoders: Mapping[str, EncoderFacts], looks: Looks) -> Figure:
    figure, panels = panel_grid(len(encoders), 2.5)
    look = looks()
    for axes, (representation, encoder) in zip(panels, encoders.items(), strict=True):
        axes.set_axis_off()
        _draw_layers(axes, encoder, look[representation]["color"])
        axes.set_title(plain(_title(representation, encoder.shown)), loc="center")
    return figure


def _title(representation: str, facts: ShownFacts) -> str:
    """The name, what it was trained with, and on a line below, what passes around it."""
    corrupted = f", trained with noise N(0, {facts.noise:g}²)" if facts.noise else ""
    beside = f"{', '.join(facts.keep)} passed around" if facts.keep else ""
    return "\n".join(filter(None, (f"{representation}{corrupted}", fill(beside, _TITLE))))


def _draw_layers(axes: Axes, encoder: EncoderFacts, colour: str) -> None:
    """A column of units for each layer, joined to the next one's."""
    sizes = [(encoder.size, "scaled"), *encoder.encoder, *encoder.decoder]
    latent = len(encoder.encoder)
    columns = [_heights(units) for units, _ in sizes]
    for x, (left, right) in enumerate(pairwise(columns)):
        lines = [((x, a), (x + 1, b)) for a in left for b in right]
        axes.add_collection(LineCollection(lines, color=ink(), linewidth=0.25, alpha=0.25))
    for x, (heights, (units, words)) in enumerate(zip(columns, sizes, strict=True)):
        shade = colour if x == latent else ink()
        axes.plot(np.full(len(heights), x), heights, "o", ms=3.6, color=shade, zorder=3)
        axes.text(x, -0.08, plain(f"{units} {words}"), ha="center", va="top", size=6.5)
    names = {0: "observation", len(sizes) - 1: "reconstruction"} | {latent: "latent"}
    for x, name in names.items():
        shade = colour if x == latent else ink()
        axes.text(x, -0.17, name, ha="center", va="top", size=6, color=shade, weight="bold")
    axes.set(xlim=(-0.45, len(sizes) - 0.55), ylim=(-0.26, 1.04))


def _heights(units: int) -> Any:
    """Where a layer's units stand, around the middle."""
    shown = min(units, _MOST)
    return 0.5 + (np.arange(shown) - (shown - 1) / 2) / _MOST


def _hidden(layers: Sequence[int] | Mapping[str, Sequence[int]]) -> str:
    """Units of hidden layers: 64-64, or pi 64-64, qf 256-256."""
    if isinstance(layers, Mapping):
        return ", ".join(f"{name} {_hidden(units)}" for name, units in layers.items())
    return "-".join(map(str, layers)) or "none"


def system(shared: Label, looks: Looks) -> Plot:
    """Robot, observation, encoder, agent, action."""
    settings, encoder = shared.settings, shared.encoder
    latent = encoder.latent_size or encoder.encoder[-1][0]
    hidden = _hidden(settings.hyperparameters.net_arch)
    task = settings.environment
    action = _action(task)
    step = f" of {task.timestep:g} s" if task.timestep else ""
    boxes = [
        ("robot", settings.task + (f"\nsteps{step}" if step else "")),
        ("observation", f"{encoder.size} features\n{_scaled(encoder.shown)}"),
        ("encoder", f"{settings.representation}\n{encoder.size} to {latent}"),
        ("latent", counted(latent, "number")),
        ("agent", f"{settings.algorithm.upper()}\nhidden {hidden}"),
    ]
    return Plot(
        "system",
        "The system",
        f"What an agent sees and does in each step{step}.",
        ("part", "what"),
        [(name, what.replace("\n", ", ")) for name, what in [*boxes, ("action", action)]],
        lambda: _draw_system(boxes, action, looks()[settings.representation]["color"]),
    )


def _scaled(facts: ShownFacts) -> str:
    how = "scaled to [-1, 1]" if facts.scaling == EXTREMA else f"{facts.scaling} scaling"
    return how if facts.on == OBSERVATION else f"{facts.on}, {how}"


def _action(task: Task) -> str:
    """Such as 6 numbers in [-1, 1]; without bounds where they differ."""
    numbers = counted(len(task.action_low), "number")
    bounds = set(zip(task.action_low, task.action_high, strict=True))
    return f"{numbers} in [{{:g}}, {{:g}}]".format(*bounds.pop()) if len(bounds) == 1 else numbers


def _draw_system(boxes: Sequence[tuple[str, str]], action: str, reduced: str) -> Figure:
    """Boxes in a row, the encoder and its latent in the colour of the representation."""
    figure = Figure(figsize=(PAGE, 1.45))
    axes: Axes = figure.subplots()
    axes.set_axis_off()
    axes.set(xlim=(-0.05, len(boxes) * 1.25 - 0.2), ylim=(-0.55, 1.05))
    for i, (name, what) in enumerate(boxes):
        x, colour = 1.25 * i, reduced if name in ("encoder", "latent") else ink()
        box = FancyBboxPatch(
            (x, 0.1), 1, 0.8, "round,pad=0,rounding_size=.08", fc="none", ec=colour
        )
        axes.add_patch(box)
        axes.text(x + 0.5, 0.76, name, ha="center", va="center", weight="bold", color=colour)
        parts = what.replace("/", "/\n").splitlines()
        lines = "\n".join(fill(part, _BOX) for part in parts)
        axes.text(x + 0.5, 0.4, plain(lines), ha="center", va="center", size=6.5)
        if i:
            _arrow(axes, (x - 0.25, 0.5), (x, 0.5))
    last = 1.25 * (len(boxes) - 1) + 0.5
    axes.plot([last, last, 0.5], [0.1, -0.3, -0.3], color=ink(), lw=0.8, solid_capstyle="butt")
    _arrow(axes, (0.5, -0.3), (0.5, 0.1))
    axes.text((last + 0.5) / 2, -0.33, f"action: {action}", ha="center", va="top", size=6.5)
    return figure


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    shape: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 7, "shrinkA": 0, "shrinkB": 0}
    axes.add_patch(FancyArrowPatch(start, end, color=ink(), lw=0.8, **shape))
