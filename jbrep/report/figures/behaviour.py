"""What policies do: how the motor turns, and where the robot goes (the paper's Figs. 4 and 5)."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from jbrep.play.behaviour import FIGURES, Behaviour
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import COLUMN, PAGE, ink, plain, styles
from jbrep.stats.bootstrap import Array

_ACROSS = 4  # panels, at most


def behaviour_plots(
    task: str, behaviours: Sequence[Behaviour], speeds: Array, target_yaw: float
) -> list[Plot]:
    """Histograms of the motor velocity, and heat maps of position.

    Args:
        task: of the policies.
        behaviours: of each policy.
        speeds: edges of the bins of motor velocity [rad/s], (b + 1,).
        target_yaw: the direction of the targets [rad].
    """
    counts = sorted({len(each.returns) for each in behaviours})
    episodes = f"{' or '.join(map(str, counts))} episodes"
    return [
        Plot(
            FIGURES[0],
            f"{task}: how the motor turns",
            f"Share of time at each motor velocity over {episodes}, with their median return.",
            ("policy", "low", "high", "share"),
            [
                (each.name, low, high, share)
                for each in behaviours
                for low, high, share in zip(speeds, speeds[1:], each.motor, strict=False)
            ],
            lambda: _draw_motor(task, behaviours, speeds),
        ),
        Plot(
            FIGURES[1],
            f"{task}: where the robot goes",
            f"Share of time in each 2 cm cell over {episodes} that start at the circle; "
            "the arrow points in the target's direction.",
            ("policy", "x", "y", "share"),
            [row for each in behaviours for row in _cells(each)],
            lambda: _draw_places(behaviours, target_yaw),
        ),
    ]


def _cells(each: Behaviour) -> list[tuple[str, str, str, float]]:
    """The cells that were visited, by their centres."""
    middles = (each.edges[:-1] + each.edges[1:]) / 2
    return [
        (each.name, f"{middles[i]:.3f}", f"{middles[j]:.3f}", each.places[i, j])
        for i, j in np.argwhere(each.places)
    ]


def _draw_motor(task: str, behaviours: Sequence[Behaviour], speeds: Array) -> Figure:
    """A panel for each policy with a scale of its own, as some stand still most of the time."""
    figure = Figure(figsize=(COLUMN, 0.65 + 0.85 * len(behaviours)))
    panels = figure.subplots(len(behaviours), sharex=True, squeeze=False)[:, 0]
    look = styles(each.name for each in behaviours)
    for axes, each in zip(panels, behaviours, strict=True):
        colour = look[each.name]["color"]
        axes.stairs(100 * each.motor, speeds, color=colour, fill=True, alpha=0.75)
        axes.set_title(plain(f"{each.name}: return {np.median(each.returns):.0f}"))
        axes.set(xlim=(-180, 180), ylabel="time [%]")
        axes.set_xticks(range(-150, 151, 50))
    panels[-1].set_xlabel("motor velocity [rad/s]")
    figure.suptitle(f"{task}: how the motor turns", size=8)
    return figure


def _draw_places(behaviours: Sequence[Behaviour], target_yaw: float) -> Figure:
    rows = -(-len(behaviours) // _ACROSS)
    across = -(-len(behaviours) // rows)
    width = COLUMN if across == 1 else PAGE
    figure = Figure(figsize=(width, 0.55 + rows * (0.4 + (width - 0.8) / across)))
    grid = figure.subplots(rows, across, squeeze=False, sharex=True, sharey=True)
    panels = grid.ravel(order="F")  # before and after training are one above the other
    lowest = min(each.places[each.places > 0].min() for each in behaviours)
    norm = LogNorm(lowest, max(each.places.max() for each in behaviours))
    for axes in panels[len(behaviours) :]:
        axes.set_axis_off()
    for number, (axes, each) in enumerate(zip(panels, behaviours, strict=False), 1):
        at_bottom = number % rows == 0 or number == len(behaviours)
        shown = np.ma.masked_equal(each.places.T, 0)
        mesh = axes.pcolormesh(each.edges, each.edges, shown, norm=norm, cmap="viridis")
        mesh.set_rasterized(True)
        _draw_target(axes, each.edges[-1], target_yaw)
        title = f"{each.name}\nreturn {np.median(each.returns):.0f}"
        axes.set_title(plain(title.replace(", ", "\n")), size=6.5)
        axes.set(aspect="equal", xlabel="x [m]" if at_bottom else "")
        axes.tick_params(labelbottom=at_bottom)
        axes.set_ylabel("y [m]" if number <= rows else "")
    figure.colorbar(mesh, ax=panels.tolist(), label="share of time", shrink=0.85, aspect=30)
    return figure


def _draw_target(axes: Axes, reach: float, yaw: float) -> None:
    """A circle at the start, and an arrow at the border."""
    axes.plot(0, 0, "o", color=ink(), ms=8, mfc="none", mew=0.8)
    tip, tail = (
        (share * reach * np.cos(yaw), share * reach * np.sin(yaw)) for share in (0.95, 0.7)
    )
    style = {"arrowstyle": "-|>", "color": ink(), "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, tail, arrowprops=style)
