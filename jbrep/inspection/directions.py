"""A code's directions from slowest to fastest, named by what they correlate with."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr

from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Array, Task
from jbrep.evaluate.truth import state
from jbrep.inspection.forecast import Examples, columns, encode
from jbrep.inspection.recording import SKY, Recording

PATH = "latent/directions"
LAG = 10  # steps
_MOST = 12  # shown: of more, the slowest and the fastest
_SLOW = 0.5  # autocorrelation at the lag, from which a direction is called slow
_NEGLIGIBLE = 1e-9  # variance, as a share of the largest


class Directions(NamedTuple):
    """Uncorrelated directions of a code, the slowest first.

    Attributes:
        mean: of the code, (l,).
        weight: directions (k, l), in which the code has a standard deviation of 1.
        autocorrelation: at the lag, (k,).
        labels: what each is and correlates with, such as "slow 1: heading cos, r = 0.97".
    """

    mean: Array
    weight: Array
    autocorrelation: Array
    labels: Sequence[str] = ()

    def __call__(self, latent: Array) -> Array:
        """Codes (n, l) along the directions, (n, k)."""
        return (latent - self.mean) @ self.weight.T

    @property
    def paths(self) -> dict[str, str]:
        """The entity of each direction, by its label."""
        return {
            label: f"{PATH}/{label.partition(':')[0].replace(' ', '_')}" for label in self.labels
        }


def slow_to_fast(latents: Sequence[Array], lag: int) -> Directions:
    """The generalised eigenvectors of lagged covariance and covariance (TICA).

    As jbrep.methods.lagged.Slow, of codes; directions in which the code doesn't vary are left out.

    Args:
        latents: codes (n, l) of parts of episodes.
        lag: steps, fewer than the rows of the longest part.
    """
    now = np.concatenate([each[:-lag] for each in latents])
    later = np.concatenate([each[lag:] for each in latents])
    mean = (now.mean(axis=0) + later.mean(axis=0)) / 2
    now, later = now - mean, later - mean
    covariance = (now.T @ now + later.T @ later) / (2 * len(now))
    across = now.T @ later / len(now)
    deviation = np.sqrt(np.diag(covariance))
    deviation = np.where(deviation > 0, deviation, 1)
    variances, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    kept = variances > _NEGLIGIBLE * max(variances[-1], _NEGLIGIBLE)
    whiten = (vectors[:, kept] / np.sqrt(variances[kept])).T / deviation
    slowness, turned = np.linalg.eigh(whiten @ ((across + across.T) / 2) @ whiten.T)
    return Directions(mean, turned[:, ::-1].T @ whiten, slowness[::-1])


def name_directions(encoder: BaseEncoder, task: Task, examples: Examples) -> Directions | None:
    """The code's slowest and fastest directions, turned to correlate positively with their names.

    Each is named by the column of the state that it correlates with most, over the examples.

    Returns:
        At most twelve; None if the code doesn't vary, or there is but one state of each episode.
    """
    latents = [encode(encoder, rows) for rows in examples.observations]
    lag = min(LAG, max(map(len, latents)) - 1)
    if lag < 1:
        return None
    every = slow_to_fast(latents, lag)
    count = len(every.weight)
    if not count:
        return None
    numbers = np.unique([*range(count)[: _MOST // 2], *range(count)[-_MOST // 2 :]])
    along = every(np.concatenate(latents))[:, numbers]
    true = np.concatenate([columns(task, rows) for rows in examples.observations])
    related = _correlation(along, true)
    best = np.abs(related).argmax(axis=1)
    largest = related[range(len(best)), best]
    weight = every.weight[numbers] * np.where(largest < 0, -1, 1)[:, None]
    slowness = every.autocorrelation[numbers]
    names = list(state(task, examples.observations[0][:1]))
    labels = [
        f"{'slow' if slow > _SLOW else 'fast'} {number + 1}: {names[i].replace('_', ' ')}, "
        f"r = {abs(r):.2f}"
        for number, slow, i, r in zip(numbers, slowness, best, largest, strict=True)
    ]
    return Directions(every.mean, weight, slowness, labels)


def _correlation(left: Array, right: Array) -> Array:
    """Correlations (k, c) of columns (n, k) and (n, c); 0 with what is constant."""
    left, right = left - left.mean(axis=0), right - right.mean(axis=0)
    lengths = np.outer(np.linalg.norm(left, axis=0), np.linalg.norm(right, axis=0))
    varies = np.outer(np.ptp(left, axis=0) > 0, np.ptp(right, axis=0) > 0) & (lengths > 0)
    return np.where(varies, left.T @ right / np.where(varies, lengths, 1), 0)


def send_directions(
    recording: Recording, times: Sequence[rr.TimeColumn], latent: Array, directions: Directions
) -> None:
    """Send codes (n, l) along each direction."""
    along = directions(latent)
    labelled = zip(directions.paths.items(), directions.autocorrelation, strict=True)
    for i, ((label, path), slowness) in enumerate(labelled):
        name = f"{label}; autocorrelation {slowness:.2f}"
        recording.send_series(path, times, along[:, [i]], [name], [SKY])
