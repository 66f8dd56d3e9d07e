"""The viewer's layout of each recording."""

from collections.abc import Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from jbrep.encoders import Encoder
from jbrep.inspection.ghost import ALIGNED
from jbrep.inspection.latent import PATH
from jbrep.inspection.recording import PROVENANCE
from jbrep.inspection.scene import ROBOT, TRAIL, WORLD
from jbrep.inspection.signals import STEP, TIME
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, Array, Task

TRAVERSE = "traverse"  # a timeline, and the parent entity of its series
TRAINING_STEP = "training_step"
_BACKGROUND = (38, 42, 50)
_CHECKS = rrb.LineGrid3D(spacing=0.01, color=(255, 255, 255, 24), stroke_width=0.7)
_TAIL = 0.3  # [s] of the latent's path that are drawn as a line
_NEAR = 1.0  # [s] shown before and after the current time: plots of signals at motor frequency
_ROOT = f"{ROBOT}/jitterbug"


def episode_layout(task: Task, encoder: Encoder | None) -> rrb.Blueprint:
    """The robot on the left, its signals on the right."""
    about = rrb.TextDocumentView(origin=PROVENANCE, name="provenance")
    near = _window(_NEAR, _NEAR)
    action = _series("action", ["action"], time_ranges=near)
    motor = rrb.Horizontal(action, _series("reward", ["reward/**"]))
    if encoder is None:
        numbers: list[rrb.Container | rrb.View] = [
            rrb.Tabs(_features("observation", task, ["observation"]), about),
            motor,
        ]
        return _blueprint(rrb.Horizontal(_world("robot"), _column(numbers)), TIME)
    both = _features("observation (thick) and decoded", task, ["observation", "reconstruction"])
    errors = _features("error", task, ["error"], "scaled", ("error/bodies", "error/total"))
    latent = _series("latent", ["latent/units"], time_ranges=near)
    scene = rrb.Vertical(
        _world("robot and decoded robot: blue is 1 mm off, yellow 10 cm"),
        rrb.Horizontal(_aligned(), _path()),
        row_shares=[1.6, 1],
    )
    numbers = [rrb.Tabs(both, errors, about), latent, motor]
    return _blueprint(rrb.Horizontal(scene, _column(numbers)), TIME)


def traversal_layout(places: Array) -> rrb.Blueprint:
    """The row of robots above, plots of the features that their units move below."""
    half = places[:, 0].max() + 0.1
    eye = rrb.EyeControls3D(position=(0, -0.75 * half, 0.25 * half), look_target=(0, 0, 0.04))
    view = rrb.Spatial3DView(
        origin=WORLD,
        name="a robot for each unit",
        eye_controls=eye,
        background=_BACKGROUND,
        line_grid=_CHECKS,
    )
    plots = [_series(f"unit {i}", [f"{TRAVERSE}/unit_{i}/most"]) for i in range(len(places))]
    summary = rrb.TextDocumentView(origin=f"{TRAVERSE}/summary", name="what each unit moves")
    about = rrb.TextDocumentView(origin=PROVENANCE, name="provenance")
    below = rrb.Horizontal(rrb.Grid(*plots), rrb.Tabs(summary, about), column_shares=[1.4, 1])
    return _blueprint(rrb.Vertical(view, below), TRAVERSE)


def curves_layout(groups: Sequence[str], last_step: int) -> rrb.Blueprint:
    """A plot for each task and algorithm."""
    training = rrb.TimeAxis(
        view_range=rr.TimeRange(
            start=rrb.TimeRangeBoundary.absolute(seq=0),
            end=rrb.TimeRangeBoundary.absolute(seq=last_step),
        )
    )
    plots = [
        _series(
            f"{group}: mean return",
            [f"{group}/**"],
            axis_x=training,
        )
        for group in groups
    ]
    text = rrb.TextDocumentView(origin=PROVENANCE, name="runs")
    layout = rrb.Horizontal(rrb.Grid(*plots), text, column_shares=[2, 1])
    return _blueprint(layout, TRAINING_STEP)


def _blueprint(layout: rrb.Container, timeline: str) -> rrb.Blueprint:
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(state="collapsed", timeline=timeline),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _column(numbers: Sequence[rrb.Container | rrb.View]) -> rrb.Vertical:
    """Stacked views, of which the first takes more than half of the height."""
    return rrb.Vertical(*numbers, row_shares=[1.2 * len(numbers), *[1.2] * (len(numbers) - 2), 1])


def _world(name: str) -> rrb.Spatial3DView:
    """The scene, seen by a camera that follows the robot."""
    eye = rrb.EyeControls3D(
        position=(0.1, -0.19, 0.12), look_target=(0, 0, 0.03), tracking_entity=_ROOT
    )
    return rrb.Spatial3DView(
        origin=WORLD,
        contents=[f"{WORLD}/**", f"- {ALIGNED}/**"],
        name=name,
        eye_controls=eye,
        overrides={TRAIL: _window(None)},
        background=_BACKGROUND,
        line_grid=_CHECKS,
    )


def _aligned() -> rrb.Spatial3DView:
    """Seen from the robot: its decoded orientation and motor angle."""
    eye = rrb.EyeControls3D(position=(0.07, -0.1, 0.05), look_target=(0, 0, 0.002))
    return rrb.Spatial3DView(
        origin=_ROOT,
        contents=[f"{ROBOT}/**", f"{ALIGNED}/**"],
        name="decoded orientation, overlaid on the robot",
        eye_controls=eye,
        background=_BACKGROUND,
        line_grid=False,
    )


def _path() -> rrb.Spatial2DView:
    """The latent's first two principal components."""
    return rrb.Spatial2DView(
        origin="latent",
        contents=[f"{PATH}/**"],
        name=f"latent: two principal components, the last {_TAIL} s as a line",
        overrides={PATH: _window(_TAIL)},
        background=_BACKGROUND,
    )


def _window(before: float | None, after: float = 0.0) -> rrb.VisibleTimeRanges:
    """The seconds shown before and after the current time; None shows all before."""
    edge = rrb.TimeRangeBoundary
    ends = []
    for seconds in (-before if before is not None else None, after):
        if seconds is None:
            ends.append((edge.infinite(), edge.infinite()))
        else:
            steps = round(seconds / CONTROL_TIMESTEP)
            ends.append((edge.cursor_relative(seq=steps), edge.cursor_relative(seconds=seconds)))
    starts, stops = ends
    return rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(timeline, start=start, end=end)
            for timeline, start, end in zip((STEP, TIME), starts, stops, strict=True)
        ]
    )


def _features(
    name: str, task: Task, roots: Sequence[str], unit: str = "", others: Sequence[str] = ()
) -> rrb.Grid:
    """A plot for each observable, then one for each of the other entities."""
    plots = [
        _series(
            f"{observable.name} [{unit or observable.features[0].unit}]",
            [f"{root}/{observable.name}" for root in roots],
            plot_legend=rrb.PlotLegend(visible=False),
            time_ranges=_window(_NEAR, _NEAR),
        )
        for observable in task.observables
    ]
    return rrb.Grid(*plots, *(_series(each, [each]) for each in others), name=name, grid_columns=2)


def _series(name: str, contents: Sequence[str], **settings: Any) -> rrb.TimeSeriesView:
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    return rrb.TimeSeriesView(name=name, contents=contents, **{"plot_legend": corner, **settings})
