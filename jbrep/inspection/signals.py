"""An episode's signals, and an encoder's, as lines: an entity for each plot."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Array, Task
from jbrep.inspection.recording import GREY, SKY, YELLOW, Recording, pieces
from jbrep.play.rollout import Rollout

STEP = "step"
TIME = "time"
MOST_LINES = 12  # in a plot
PATH = "latent/path"
_ALL_COLOUR = (90, 98, 112)
_ALL_RADIUS, _PATH_RADIUS, _NOW_RADIUS = -1.2, -1.0, -6.0  # negative: Rerun's [points]


def panels(groups: Mapping[str, slice]) -> dict[str, slice]:
    """A plot for each group of numbers, or several of about equal size for a large one.

    Returns:
        Where their lines are among all numbers, by the names of their entities.
    """
    found = {}
    for name, place in groups.items():
        size = place.stop - place.start
        count = -(-size // MOST_LINES)
        bounds = [size * i // count for i in range(count + 1)]
        for start, stop in itertools.pairwise(bounds):
            part = name if count == 1 else f"{name}_{start}-{stop - 1}"
            found[part] = slice(place.start + start, place.start + stop)
    return found


def numbered_panels(name: str, size: int) -> dict[str, slice]:
    """The same of so many numbers in one group."""
    return panels({name: slice(0, size)})


def scaled_titles(task: Task) -> list[str]:
    """Titles of features in scaled units."""
    return [f"{name} [scaled]" for name in task.feature_names]


def times_at(task: Task, steps: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """The timelines of an episode at steps (n,); of steps alone where their time isn't known."""
    timelines = [rr.TimeColumn(STEP, sequence=steps)]
    if task.timestep is not None:
        nanoseconds = np.rint(1e9 * task.timestep * steps).astype("timedelta64[ns]")
        timelines.append(rr.TimeColumn(TIME, duration=nanoseconds))
    return timelines


def send_signals(recording: Recording, rollout: Rollout) -> None:
    """Send observations, actions and rewards, as far as they are known."""
    task, states = rollout.task, np.arange(len(rollout) + 1)
    titles, times = [str(feature) for feature in task.features], times_at(task, states)
    send_features(recording, "observation", times, task, rollout.observation, titles)
    acting = times_at(task, states[:-1])
    taken = zip(task.named_actions, task.action_low, task.action_high, strict=True)
    names = [f"{name} [{low:g}, {high:g}]" for name, low, high in taken]
    for name, place in numbered_panels("action", task.action_size).items():
        recording.send_series(name, acting, rollout.action[:, place], names[place])
    if np.isfinite(rollout.reward).any():
        total, led_to = rollout.reward[:, None], times_at(task, states[1:])
        recording.send_series("reward/total", led_to, total, ["reward"], [GREY])


def send_features(
    recording: Recording,
    path: str,
    times: Sequence[rr.TimeColumn],
    task: Task,
    values: NDArray[np.floating],
    titles: Sequence[str],
    width: float = 2.0,
) -> None:
    """Send features (n, d), an entity for each panel, in lines of that width [points]."""
    for name, place in panels(task.groups).items():
        lines = titles[place]
        recording.send_series(f"{path}/{name}", times, values[:, place], lines, width=width)


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
        task, name = rollout.task, "reconstruction"
        titles = [str(f).replace(f.name, f"{f.name} decoded", 1) for f in task.features]
        send_features(recording, name, times, task, decoded, titles, width=1.0)
        true = rollout.observation.astype(np.float64)
        errors = encoder.scale(encoder.comparable(decoded, true)) - encoder.scale(true)
        single, titles = errors.astype(np.float32), scaled_titles(task)
        send_features(recording, "error", times, task, single, titles)
        total = np.sqrt(np.square(errors).mean(axis=1, keepdims=True))
        recording.send_series("error/total", times, total, ["root mean square [scaled]"])
    names = [f"unit {i}" for i in range(encoder.latent_size)]
    for name, place in numbered_panels("units", encoder.latent_size).items():
        recording.send_series(f"latent/{name}", times, latent[:, place], names[place])
    path = principal_components(latent.astype(np.float64))
    recording.send(f"{PATH}/all", rr.Points2D(path, colors=[_ALL_COLOUR], radii=[_ALL_RADIUS]))
    recording.send_moving(PATH, times, rr.LineStrips2D, SKY, _PATH_RADIUS, strips=pieces(path))
    recording.send_moving(f"{PATH}/now", times, rr.Points2D, YELLOW, _NOW_RADIUS, positions=path)


def principal_components(latent: Array) -> Array:
    """The first two principal components (n, 2) of latents (n, l)."""
    centred = latent - latent.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    two = np.zeros((2, latent.shape[1]))
    two[: len(directions)] = directions[:2]
    largest = two[[0, 1], np.abs(two).argmax(axis=1)]
    signs = np.where(largest < 0, -1, 1)  # the SVD's are arbitrary
    return centred @ (two * signs[:, None]).T
