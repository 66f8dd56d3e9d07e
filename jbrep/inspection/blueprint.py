"""The viewer's layout of each recording."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Array, Task
from jbrep.inspection.recording import PROVENANCE
from jbrep.inspection.robot import Robot
from jbrep.inspection.scene import ROBOT, TRAIL, WORLD
from jbrep.inspection.signals import PATH, STEP, TIME, numbered_panels, panels
from jbrep.jitterbug.tasks import jitterbug_task

TRAVERSE = "traverse"  # a timeline, and the parent entity of its series
_BACKGROUND = (38, 42, 50)
_TAIL = 0.3  # [s] of the latent's path that are drawn as a line
_NEAR = 1.0  # [s] shown before and after the current time: plots of signals at motor frequency
_USUAL_TIMESTEP = 0.01  # [s] where a task's isn't known
_MOST_PLOTS = 12  # on a page
_EYE = (1.3, -2.5, 1.2)  # in sizes of the robot, from its root


def episode_layout(task: Task, robot: Robot | None, encoder: BaseEncoder | None) -> rrb.Blueprint:
    """The robot on the left, its signals on the right; the signals alone if there is no robot."""
    decodes = encoder is not None and encoder.can_decode
    has_ghost = decodes and robot is not None and jitterbug_task(task) is not None
    signals = _features("observation", task, ["observation"])
    if decodes:
        both = ["observation", "reconstruction"]
        totals = ["error/bodies", "error/total"] if has_ghost else ["error/total"]
        signals = [
            *_features("observation (thick) and decoded", task, both),
            *_features("error", task, ["error"], "scaled", totals),
        ]
    about = rrb.TextDocumentView(origin=PROVENANCE, name="provenance")
    numbers: list[rrb.Container] = [rrb.Tabs(*signals, about)]
    near = {"time_ranges": _window(task, _NEAR, _NEAR)}
    if encoder:
        units = [
            _series(path.replace("units", "latent").replace("_", " "), [f"latent/{path}"], **near)
            for path in numbered_panels("units", encoder.latent_size)
        ]
        numbers.append(_tabs(_pages("latent", units)))
    actions = numbered_panels("action", task.action_size)
    acting = _pages("action", [_series(path, [path], **near) for path in actions])
    numbers.append(rrb.Horizontal(*acting, _series("reward", ["reward/total"])))
    shares = [1.2 * len(numbers), *[1.2] * (len(numbers) - 2), 1]
    column = rrb.Vertical(*numbers, row_shares=shares)
    scene: list[rrb.View] = []
    if robot:
        following = rrb.EyeControls3D(
            position=robot.place + robot.size * np.array(_EYE),
            look_target=robot.place,
            tracking_entity=f"{ROBOT}/{robot.names[robot.root]}",
        )
        ghost = "robot and decoded robot: blue is 1 mm off, yellow 10 cm"
        shown, trail = ghost if has_ghost else "robot", {TRAIL: _window(task, None)}
        scene.append(_world(shown, robot, eye_controls=following, overrides=trail))
    if encoder:
        scene.append(_path(task))
    left = [rrb.Vertical(*scene, row_shares=[1.6, 1][-len(scene) :])] if scene else []
    return _blueprint(rrb.Horizontal(*left, column), STEP if task.timestep is None else TIME)


def traversal_layout(units: int, robot: Robot | None, places: Array) -> rrb.Blueprint:
    """The row of robots above, plots of the features that their units move below."""
    plots = [_series(f"unit {i}", [f"{TRAVERSE}/unit_{i}/most"]) for i in range(units)]
    summary = rrb.TextDocumentView(origin=f"{TRAVERSE}/summary", name="what each unit moves")
    about = rrb.TextDocumentView(origin=PROVENANCE, name="provenance")
    below = rrb.Horizontal(
        _tabs(_pages("units", plots)), rrb.Tabs(summary, about), column_shares=[1.4, 1]
    )
    if robot is None:
        return _blueprint(below, TRAVERSE)
    half = places[:, 0].max() + 1.3 * robot.size
    eye = rrb.EyeControls3D(position=(0, -0.75 * half, 0.25 * half), look_target=(0, 0, 0.04))
    view = _world("a robot for each unit", robot, eye_controls=eye)
    return _blueprint(rrb.Vertical(view, below), TRAVERSE)


def _blueprint(layout: rrb.Container | rrb.View, timeline: str) -> rrb.Blueprint:
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="playing", loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _world(name: str, robot: Robot, **settings: Any) -> rrb.Spatial3DView:
    """The scene, on lines 1 cm apart for a robot of some cm, 10 cm for one ten times as large."""
    spacing = 10.0 ** math.floor(math.log10(robot.size / 3))
    grid = rrb.LineGrid3D(spacing=spacing, color=(255, 255, 255, 24), stroke_width=0.7)
    return rrb.Spatial3DView(
        origin=WORLD, name=name, background=_BACKGROUND, line_grid=grid, **settings
    )


def _path(task: Task) -> rrb.Spatial2DView:
    tail = f"{_TAIL} s" if task.timestep else f"{round(_TAIL / _USUAL_TIMESTEP)} steps"
    return rrb.Spatial2DView(
        origin="latent",
        contents=[f"{PATH}/**"],
        name=f"latent: two principal components, the last {tail} as a line",
        overrides={PATH: _window(task, _TAIL)},
        background=_BACKGROUND,
    )


def _window(task: Task, before: float | None, after: float = 0.0) -> rrb.VisibleTimeRanges:
    """The seconds shown before and after the current time; None shows all before."""
    edge, timestep = rrb.TimeRangeBoundary, task.timestep or _USUAL_TIMESTEP
    relative, starts = edge.cursor_relative, [edge.infinite()] * 2
    if before is not None:
        starts = [relative(seq=-round(before / timestep)), relative(seconds=-before)]
    stops = [relative(seq=round(after / timestep)), relative(seconds=after)]
    ends = zip((STEP, TIME), starts, stops, strict=True)
    return rrb.VisibleTimeRanges([rrb.VisibleTimeRange(t, start=a, end=b) for t, a, b in ends])


def _features(
    name: str, task: Task, roots: Sequence[str], unit: str = "", others: Sequence[str] = ()
) -> list[rrb.Grid]:
    """Pages with a plot for each panel of features, then one for each of the other entities."""
    legend = rrb.PlotLegend(visible=False)
    look = {"plot_legend": legend, "time_ranges": _window(task, _NEAR, _NEAR)}
    plots = []
    for panel, place in panels(task.groups).items():
        shown = unit or task.features[place.start].unit
        title = f"{panel} [{shown}]" if shown else panel
        plots.append(_series(title, [f"{root}/{panel}" for root in roots], **look))
    return _pages(name, [*plots, *(_series(each, [each]) for each in others)])


def _pages(name: str, plots: Sequence[rrb.View]) -> list[rrb.Grid]:
    count = -(-len(plots) // _MOST_PLOTS)
    parts = [plots[len(plots) * i // count : len(plots) * (i + 1) // count] for i in range(count)]
    return [
        rrb.Grid(
            *part,
            name=name if count == 1 else f"{name}, {i} of {count}",
            grid_columns=min(2, len(part)),
        )
        for i, part in enumerate(parts, start=1)
    ]


def _tabs(pages: Sequence[rrb.Grid]) -> rrb.Container:
    return pages[0] if len(pages) == 1 else rrb.Tabs(*pages)


def _series(name: str, contents: Sequence[str], **settings: Any) -> rrb.TimeSeriesView:
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(name=name, contents=contents, **{"plot_legend": corner, **settings})
