"""An episode's signals as lines, with an entity for each group."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.inspection.recording import GREY, Recording, lighten, palette
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, Array, Task
from jbrep.rollouts.rollout import Rollout

STEP = "step"
TIME = "time"
_DECODED_WIDTH = 1.0  # [points]
_NANOSECONDS = round(1e9 * CONTROL_TIMESTEP)  # in a control step


def times_at(steps: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """The timelines of an episode at control steps (n,)."""
    simulated = (_NANOSECONDS * steps).astype("timedelta64[ns]")
    return [rr.TimeColumn(STEP, sequence=steps), rr.TimeColumn(TIME, duration=simulated)]


def send_signals(recording: Recording, rollout: Rollout) -> None:
    """Send the observation and reward terms of each state, the actions and the rewards."""
    states = np.arange(len(rollout) + 1)
    send_features(recording, "observation", times_at(states), rollout.task, rollout.observation)
    recording.send_series("action", times_at(states[:-1]), rollout.action, ["drive [1]"])
    terms = np.stack(list(rollout.terms.values()), axis=1)
    recording.send_series(
        "reward/terms", times_at(states), terms, [f"{name} [1]" for name in rollout.terms]
    )
    total = rollout.reward[:, None]
    recording.send_series("reward/total", times_at(states[1:]), total, ["reward [1]"], [GREY])


def send_features(
    recording: Recording,
    path: str,
    times: Sequence[rr.TimeColumn],
    task: Task,
    values: Array,
    unit: str | None = None,
) -> None:
    """Send features (n, d), an entity for each observable.

    Their unit is the one given, or each feature's own.
    """
    for observable, part in zip(task.observables, task.split(values).values(), strict=True):
        names = [f"{feature.name} [{unit or feature.unit}]" for feature in observable.features]
        recording.send_series(f"{path}/{observable.name}", times, part, names)


def send_decoded(
    recording: Recording, times: Sequence[rr.TimeColumn], task: Task, values: Array
) -> None:
    """Send decoded features (n, d), as lighter and thinner lines than the observation's."""
    for observable, part in zip(task.observables, task.split(values).values(), strict=True):
        names = [f"{feature.name} decoded [{feature.unit}]" for feature in observable.features]
        colours = [lighten(colour) for colour in palette(len(names))]
        path = f"reconstruction/{observable.name}"
        recording.send_series(path, times, part, names, colours, _DECODED_WIDTH)
