"""Draw what policies do: how the motor turns, and where the robot goes (the paper's Figs. 4, 5).

    python examples/behaviour/behaviour.py runs/full runs/dae-4 --out drawn
    python examples/behaviour/behaviour.py heuristic uniform --task move_in_direction --out drawn

Policies are as `jbrep behaviour` takes them, which prints the same as a table.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from jbrep.envs import describe
from jbrep.play.behaviour import SPEEDS, Behaviour, observe
from jbrep.report.figures import Plot, write
from jbrep.report.figures.panels import COLUMN, INK, PAGE, Row, line, panels, plain, styles

ACROSS = 4  # panels, at most
FULL_SPEED = 180.0  # ends of the axis of motor velocity [rad/s]


def behaviour_plots(task: str, behaviours: Sequence[Behaviour], target_yaw: float) -> list[Plot]:
    """Histograms of the motor velocity, and heat maps of position; the yaw is in radians."""
    names = [each.name for each in behaviours]
    return [
        Plot(
            "motor_velocity",
            f"{task}: how the motor turns",
            "Share of time at each motor velocity.",
            [*motor(behaviours)],
            lambda rows: panels(
                rows,
                mark=line("low", "share", drawstyle="steps-post", marker=""),
                looks=styles(names),
                facet=("policy",),
                series="policy",
                axis_labels=("motor velocity [rad/s]", "share of time"),
                across=1,
                height=0.95,
                finish=lambda axes, _: axes.set_xlim(-FULL_SPEED, FULL_SPEED),
            ),
        ),
        Plot(
            "positions",
            f"{task}: where the robot goes",
            "Share of time in each 2 cm cell, of episodes that start at the circle; the arrow "
            "points in the target's direction.",
            [*cells(behaviours)],
            lambda _: draw_places(behaviours, target_yaw),
        ),
    ]


def motor(behaviours: Sequence[Behaviour]) -> Iterator[Row]:
    """Shares of time by motor velocity [rad/s]."""
    for each in behaviours:
        for low, high, share in zip(SPEEDS, SPEEDS[1:], each.motor, strict=False):
            yield {"policy": each.name, "low": low, "high": high, "share": share}


def cells(behaviours: Sequence[Behaviour]) -> Iterator[Row]:
    """The cells that were visited, by their centres."""
    for each in behaviours:
        middles = (each.edges[:-1] + each.edges[1:]) / 2
        for i, j in np.argwhere(each.places):
            place = {"x": f"{middles[i]:.3f}", "y": f"{middles[j]:.3f}"}
            yield {"policy": each.name, **place, "share": each.places[i, j]}


def draw_places(behaviours: Sequence[Behaviour], target_yaw: float) -> Figure:
    """A panel for each policy."""
    rows = -(-len(behaviours) // ACROSS)
    across = -(-len(behaviours) // rows)
    width = COLUMN if across == 1 else PAGE
    figure = Figure(figsize=(width, 0.55 + rows * (0.4 + (width - 0.8) / across)))
    grid = figure.subplots(rows, across, squeeze=False, sharex=True, sharey=True)
    shares = np.concatenate([each.places[each.places > 0] for each in behaviours])
    norm = LogNorm(shares.min(), shares.max())
    for axes in grid.ravel()[len(behaviours) :]:
        axes.set_axis_off()
    order = grid.ravel(order="F")  # before and after training are one above the other
    for axes, each in zip(order, behaviours, strict=False):
        shown = np.ma.masked_equal(each.places.T, 0)
        mesh = axes.pcolormesh(each.edges, each.edges, shown, norm=norm, cmap="viridis")
        mesh.set_rasterized(True)
        draw_target(axes, each.edges[-1], target_yaw)
        name = each.name.replace(", ", "\n")
        axes.set_title(plain(f"{name}\nreturn {np.median(each.returns):.0f}"), size=6.5)
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    figure.colorbar(mesh, ax=grid.ravel().tolist(), label="share of time", shrink=0.85, aspect=30)
    return figure


def draw_target(axes: Axes, reach: float, yaw: float) -> None:
    """A circle at the start, and an arrow at the border."""
    axes.plot(0, 0, "o", color=INK, ms=8, mfc="none", mew=0.8)
    tip, tail = (
        (share * reach * np.cos(yaw), share * reach * np.sin(yaw)) for share in (0.95, 0.7)
    )
    style = {"arrowstyle": "-|>", "color": INK, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, tail, arrowprops=style)


def main() -> None:
    """Play and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--task", help="for policies by name")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--target-yaw", type=float, default=45.0, help="[degrees]")
    parser.add_argument("--out", type=Path, required=True, help="a folder")
    given = parser.parse_args()
    yaw = np.deg2rad(given.target_yaw)
    known = describe(given.task) if given.task else None
    task, behaviours = observe(given.policies, known, given.episodes, yaw)
    print(*write(behaviour_plots(task.name, behaviours, yaw), given.out), sep="\n")


if __name__ == "__main__":
    main()
