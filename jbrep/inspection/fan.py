"""The next steps as an encoder's code predicts them, for several sequences of actions."""

from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Array, Task
from jbrep.inspection.blueprint import series_pages
from jbrep.inspection.forecast import (
    Examples,
    Forecaster,
    columns,
    encode,
    explained,
    held,
    next_actions,
)
from jbrep.inspection.recording import GREEN, GREY, ORANGE, PURPLE, SKY, Colour, Recording
from jbrep.inspection.robot import Robot
from jbrep.inspection.signals import MOST_LINES, times_at
from jbrep.play.jitterbug import jitterbug_task
from jbrep.play.rollout import Rollout
from jbrep.text import number

FAN = "world/fan"
SERIES = "forecast"
TAKEN, TRUTH = "taken", "truth"
_EVERY = 5  # steps from one fan to the next
_APART = 25  # the same among the series, where fans must not overlap
_COLOURS: dict[str, Colour] = {
    TAKEN: ORANGE,
    "held_low": SKY,
    "held_midway": GREEN,
    "held_high": PURPLE,
}
_POSITION = ("position_x", "position_y", "position_z")
_HEADING = ("heading_cos", "heading_sin")
_LINE = 0.01  # radius, in sizes of the robot
_ARROW = 0.25  # length of the heading at the end of a line, likewise


class Fan(NamedTuple):
    """Forecasts from some of an episode's states.

    Attributes:
        source: what they were fitted to.
        names: of the state's columns.
        starts: the states from which they go out, (p,).
        steps: from there, 0 first, (h,).
        lines: of each sequence of actions, states (p, h, columns); the first is what is read from
            the code at the start itself.
        truth: the states that there were, (p, h, columns).
        explained: R^2 of each column's change after each but the first of the steps, over the
            starts and under the actions taken, (h - 1, columns).
    """

    source: str
    names: list[str]
    starts: NDArray[np.int64]
    steps: list[int]
    lines: dict[str, Array]
    truth: Array
    explained: Array

    @property
    def shown(self) -> list[str]:
        """The columns that have series."""
        return self.names[:MOST_LINES]

    @property
    def about(self) -> str:
        """What they are worth, as Markdown."""
        lines = [
            f"Forecasts are fitted to {self.source}. Grey is what came true; orange is predicted "
            "for the actions taken; blue, green and pink for all actions held at their lowest, "
            "midway and highest. R² of each quantity's change over some steps, under the actions "
            "taken in this episode:",
            "",
            f"| {' | '.join(['steps', *map(str, self.steps[1:])])} |",
            "|---" * len(self.steps) + "|",
        ]
        for name, scores in zip(self.shown, self.explained.T, strict=False):
            cells = " | ".join(map(_score, scores))
            lines.append(f"| {_words(name)} | {cells} |")
        return "\n".join(lines)


def make_fan(rollout: Rollout, encoder: BaseEncoder, examples: Examples) -> Fan | None:
    """Forecasts from every fifth state that has as many after it as are predicted.

    Nothing is used of later states; of later actions, those that are said to be taken.

    Returns:
        The forecasts; None if the episode, or the examples, are too short.
    """
    task = rollout.task
    forecaster = Forecaster(encoder, task, examples)
    ahead = [k for k in forecaster.horizons if k <= len(rollout)]
    if not ahead:
        return None
    starts = np.arange(0, len(rollout) - ahead[-1] + 1, _EVERY)
    seen, steps = rollout.observation[starts], [0, *ahead]
    latent = encode(encoder, seen)
    actions = {TAKEN: next_actions(rollout.action, ahead[-1])[starts]}
    actions |= held(task, len(starts), ahead[-1])
    now = forecaster.read(latent, seen)
    lines = {
        name: np.stack([now, *(forecaster(latent, seen, each, k) for k in ahead)], axis=1)
        for name, each in actions.items()
    }
    truth = columns(task, rollout.observation)[starts[:, None] + steps]
    scores = [
        explained(lines[TAKEN][:, i] - now, truth[:, i] - truth[:, 0]) for i in range(1, len(steps))
    ]
    return Fan(examples.source, forecaster.names, starts, steps, lines, truth, np.stack(scores))


def send_fan(recording: Recording, rollout: Rollout, fan: Fan, robot: Robot | None) -> None:
    """Send series of the state's first columns and, of the Jitterbug, lines and headings."""
    _send_series(recording, rollout, fan)
    named = {*_POSITION, *_HEADING} <= {*fan.names}  # features may have been renamed
    if robot and named and jitterbug_task(rollout.task):
        times = times_at(rollout.task, fan.starts)
        for name, states in {**fan.lines, TRUTH: fan.truth}.items():
            _send_lines(recording, times, fan, name, states, robot.size)


def fan_pages(task: Task, fan: Fan) -> list[rrb.Grid]:
    """Plots of the forecasts, beside what came true."""
    middle = len(fan.steps) // 2
    scores = fan.explained[middle - 1]
    titles = {
        f"{_words(name)}: R² {_score(score)} over {fan.steps[middle]} steps": [f"{_path(name)}/**"]
        for name, score in zip(fan.shown, scores, strict=False)
    }
    return series_pages("forecasts", task, titles)


def _score(value: float) -> str:
    return number(None if np.isnan(value) else value, ".2f")


def _words(name: str) -> str:
    return name.replace("_", " ")


def _path(name: str) -> str:
    return f"{SERIES}/{rr.escape_entity_path_part(name)}"


def _send_series(recording: Recording, rollout: Rollout, fan: Fan) -> None:
    """Send forecasts every 25 steps, with a gap after each, and the truth at all steps."""
    task, apart = rollout.task, slice(None, None, _APART // _EVERY)
    steps = fan.starts[apart, None] + np.array([*fan.steps, fan.steps[-1]])
    times, every = times_at(task, steps.ravel()), times_at(task, np.arange(len(rollout) + 1))
    true = columns(task, rollout.observation)
    for i, name in enumerate(fan.shown):
        lines = [_with_gaps(states[apart, :, i]) for states in fan.lines.values()]
        labels = [f"{_words(name)}, {_words(each)}" for each in fan.lines]
        colours = [_COLOURS[each] for each in fan.lines]
        path, values = _path(name), np.stack(lines, axis=1)
        recording.send_series(f"{path}/truth", every, true[:, [i]], [_words(name)], [GREY], 3.0)
        recording.send_series(f"{path}/ahead", times, values, labels, colours, 1.5)


def _with_gaps(values: Array) -> Array:
    """Lines (p, h), each followed by NaN, which ends it in the viewer: (p * (h + 1),)."""
    return np.column_stack((values, np.full(len(values), np.nan))).ravel()


def _send_lines(
    recording: Recording,
    times: list[rr.TimeColumn],
    fan: Fan,
    name: str,
    states: Array,
    size: float,
) -> None:
    """Send the path of the robot over the next steps, with its heading at the end."""
    path = states[..., [fan.names.index(each) for each in _POSITION]]
    turned = states[:, -1, [fan.names.index(each) for each in _HEADING]]
    ahead = _ARROW * size * np.column_stack((turned, np.zeros(len(turned))))
    lines = rr.LineStrips3D.columns(strips=path.astype(np.float32))
    arrows = rr.Arrows3D.columns(origins=path[:, -1], vectors=ahead)
    recording.send_columns(f"{FAN}/{name}", times, lines, arrows)
    look: dict[str, Any] = {"colors": [_COLOURS.get(name, GREY)], "radii": [_LINE * size]}
    shapes = (rr.LineStrips3D.from_fields(**look), rr.Arrows3D.from_fields(**look))
    recording.send(f"{FAN}/{name}", *shapes)
