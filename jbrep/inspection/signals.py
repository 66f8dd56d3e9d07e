"""An episode's signals, and an encoder's, as lines: an entity for each plot."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Feature, Task
from jbrep.inspection.recording import GREY, SKY, YELLOW, Recording, lighten, palette
from jbrep.play.jitterbug import reward_terms
from jbrep.play.rollout import Rollout

STEP = "step"
TIME = "time"
MOST_LINES = 12  # in a plot
_WIDTH, _DECODED_WIDTH = 2.0, 1.0  # of lines [points]
PATH = "latent/path"
_ALL_COLOUR = (90, 98, 112)
_ALL_RADIUS, _PATH_RADIUS, _NOW_RADIUS = -1.2, -1.0, -6.0  # negative: Rerun's [points]


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
    title: Callable[[Feature], str] = str,
    is_faint: bool = False,
) -> None:
    """Send features (n, d), an entity for each panel; faint ones are lighter and thinner."""
    for name, place in feature_panels(task):
        titles = [title(feature) for feature in task.features[place]]
        colours, width = palette(len(titles)), _WIDTH
        if is_faint:
            colours, width = [lighten(colour) for colour in colours], _DECODED_WIDTH
        recording.send_series(f"{path}/{name}", times, values[:, place], titles, colours, width)


def _decoded(feature: Feature) -> str:
    unit = f" [{feature.unit}]" if feature.unit else ""
    return f"{feature.name} decoded{unit}"


def _scaled(feature: Feature) -> str:
    return f"{feature.name} [scaled]"


def send_encoding(
    recording: Recording,
    times: Sequence[rr.TimeColumn],
    rollout: Rollout,
    encoder: BaseEncoder,
    latent: NDArray[np.float32],
    decoded: Array | None,
) -> None:
    """Send the latent (n, l), and decoded features (n, d), if any, with errors in scaled units."""
    if decoded is not None:
        path = "reconstruction"
        send_features(recording, path, times, rollout.task, decoded, _decoded, is_faint=True)
        true = encoder.scale(rollout.observation.astype(np.float64))
        errors = encoder.scale(decoded) - true
        send_features(recording, "error", times, rollout.task, errors.astype(np.float32), _scaled)
        total = np.sqrt(np.square(errors).mean(axis=1, keepdims=True))
        recording.send_series("error/total", times, total, ["root mean square [scaled]"])
    names = [f"unit {i}" for i in range(encoder.latent_size)]
    for name, place in latent_panels(encoder.latent_size):
        recording.send_series(f"latent/{name}", times, latent[:, place], names[place])
    _send_path(recording, times, latent.astype(np.float64))


def principal_components(latent: Array) -> Array:
    """The first two principal components (n, 2) of latents (n, l)."""
    centred = latent - latent.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    two = np.zeros((2, latent.shape[1]))
    two[: len(directions)] = directions[:2]
    largest = two[[0, 1], np.abs(two).argmax(axis=1)]
    signs = np.where(largest < 0, -1, 1)  # the SVD's are arbitrary
    return centred @ (two * signs[:, None]).T


def _send_path(recording: Recording, times: Sequence[rr.TimeColumn], latent: Array) -> None:
    """Send all latents as points, lines between successive ones, and the current one."""
    path = principal_components(latent)
    recording.send(f"{PATH}/all", rr.Points2D(path, colors=[_ALL_COLOUR], radii=[_ALL_RADIUS]))
    pieces = np.stack((np.concatenate((path[:1], path[:-1])), path), axis=1)
    recording.send_columns(PATH, times, rr.LineStrips2D.columns(strips=pieces.astype(np.float32)))
    recording.send(PATH, rr.LineStrips2D.from_fields(colors=[SKY], radii=[_PATH_RADIUS]))
    now = rr.Points2D.from_fields(colors=[YELLOW], radii=[_NOW_RADIUS])
    recording.send_columns(f"{PATH}/now", times, rr.Points2D.columns(positions=path))
    recording.send(f"{PATH}/now", now)
