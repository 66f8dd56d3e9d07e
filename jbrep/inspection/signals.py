"""An episode's signals as lines, with an entity for each plot."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Feature, Task
from jbrep.inspection.recording import GREY, Recording, lighten, palette
from jbrep.play.jitterbug import reward_terms
from jbrep.play.rollout import Rollout

STEP = "step"
TIME = "time"
MOST_LINES = 12  # in a plot
_DECODED_WIDTH = 1.0  # [points]


class Panel(NamedTuple):
    """The lines of a plot."""

    name: str  # of its entity
    place: slice  # of its numbers among all


def panels(groups: Mapping[str, slice]) -> Iterator[Panel]:
    """A panel for each group of numbers, or several of about equal size for a large one."""
    for name, place in groups.items():
        size = place.stop - place.start
        count = -(-size // MOST_LINES)
        if count == 1:
            yield Panel(name, place)
            continue
        bounds = [size * i // count for i in range(count + 1)]
        for start, stop in itertools.pairwise(bounds):
            there = slice(place.start + start, place.start + stop)
            yield Panel(f"{name}_{start}-{stop - 1}", there)


def feature_panels(task: Task) -> list[Panel]:
    """The panels of an observation."""
    return list(panels(task.groups))


def action_panels(task: Task) -> list[Panel]:
    """The panels of an action."""
    return list(panels({"action": slice(0, task.action_size)}))


def latent_panels(size: int) -> list[Panel]:
    """The panels of a latent with so many units."""
    return list(panels({"units": slice(0, size)}))


def times_at(task: Task, steps: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """The timelines of an episode at steps (n,); of steps alone where their time isn't known."""
    timelines = [rr.TimeColumn(STEP, sequence=steps)]
    if task.timestep is not None:
        nanoseconds = np.rint(1e9 * task.timestep * steps).astype("timedelta64[ns]")
        timelines.append(rr.TimeColumn(TIME, duration=nanoseconds))
    return timelines


def send_signals(recording: Recording, rollout: Rollout) -> None:
    """Send the observation of each state, the actions and the rewards."""
    task, states = rollout.task, np.arange(len(rollout) + 1)
    send_features(recording, "observation", times_at(task, states), task, rollout.observation)
    acting = times_at(task, states[:-1])
    bounds = zip(task.action_low, task.action_high, strict=True)
    names = [f"action_{i} [{low:g}, {high:g}]" for i, (low, high) in enumerate(bounds)]
    for name, place in action_panels(task):
        recording.send_series(name, acting, rollout.action[:, place], names[place])
    total = rollout.reward[:, None]
    recording.send_series("reward/total", times_at(task, states[1:]), total, ["reward"], [GREY])


def send_terms(recording: Recording, task: Task, motion: Motion) -> None:
    """Send the factors of the reward, if the task has some."""
    if terms := reward_terms(task, motion):
        values = np.stack(list(terms.values()), axis=1)
        times = times_at(task, np.arange(len(motion)))
        recording.send_series("reward/terms", times, values, [f"{name} [1]" for name in terms])


def send_features(
    recording: Recording,
    path: str,
    times: Sequence[rr.TimeColumn],
    task: Task,
    values: NDArray[np.floating],
    unit: str | None = None,
) -> None:
    """Send features (n, d), an entity for each panel.

    Their unit is the one given, or each feature's own.
    """
    for name, place in feature_panels(task):
        features = task.features[place]
        names = [f"{f.name} [{unit}]" if unit else str(f) for f in features]
        recording.send_series(f"{path}/{name}", times, values[:, place], names)


def send_decoded(
    recording: Recording, times: Sequence[rr.TimeColumn], task: Task, values: Array
) -> None:
    """Send decoded features (n, d), as lighter and thinner lines than the observation's."""
    for name, place in feature_panels(task):
        names = [_decoded(feature) for feature in task.features[place]]
        colours = [lighten(colour) for colour in palette(len(names))]
        path = f"reconstruction/{name}"
        recording.send_series(path, times, values[:, place], names, colours, _DECODED_WIDTH)


def _decoded(feature: Feature) -> str:
    unit = f" [{feature.unit}]" if feature.unit else ""
    return f"{feature.name} decoded{unit}"
