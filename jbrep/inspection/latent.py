"""An encoder's signals: decoded features, their errors, the latent and its path."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Array
from jbrep.inspection.recording import SKY, YELLOW, Recording
from jbrep.inspection.signals import latent_panels, send_decoded, send_features
from jbrep.play.rollout import Rollout

PATH = "latent/path"
_ALL_COLOUR = (90, 98, 112)
_ALL_RADIUS, _PATH_RADIUS, _NOW_RADIUS = -1.2, -1.0, -6.0  # negative: Rerun's [points]


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
        send_decoded(recording, times, rollout.task, decoded)
        _send_errors(recording, times, rollout, encoder.scale(decoded), encoder)
    names = [f"unit {i}" for i in range(encoder.latent_size)]
    for name, place in latent_panels(encoder.latent_size):
        recording.send_series(f"latent/{name}", times, latent[:, place], names[place])
    _send_path(recording, times, latent.astype(np.float64))


def _send_errors(
    recording: Recording,
    times: Sequence[rr.TimeColumn],
    rollout: Rollout,
    scaled: Array,
    encoder: BaseEncoder,
) -> None:
    """Send the errors of decoded features, scaled, (n, d), and their root mean square."""
    errors = scaled - encoder.scale(rollout.observation.astype(np.float64))
    send_features(recording, "error", times, rollout.task, errors.astype(np.float32), "scaled")
    total = np.sqrt(np.square(errors).mean(axis=1, keepdims=True))
    recording.send_series("error/total", times, total, ["root mean square [scaled]"])


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
