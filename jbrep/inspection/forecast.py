"""Forecasts of an encoder's code: what it and the next actions say of the next states."""

from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from jbrep.coordinates.placing import placed
from jbrep.dataset import Dataset
from jbrep.dataset.scaled import sample
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Array, Task
from jbrep.evaluate.regression import Predictor, ridge
from jbrep.evaluate.truth import state

HORIZONS = (5, 10, 15, 20)  # steps ahead
_FEWEST = 50  # windows to fit a horizon to
_HIDDEN = 200  # random ReLU features
_LIMIT = 5.0  # standard deviations of an input
_ROWS = 10_000  # about as many states in all
_EPISODES = 100  # at most
_SHORTEST = 50  # states of a part, where its episode has as many


class Examples(NamedTuple):
    """Consecutive states of some episodes, with the actions between them.

    Attributes:
        observations: of each part, (n + 1, d) in physical units.
        actions: of each part, (n, m).
        source: what they are, for the reader of a recording.
    """

    observations: list[NDArray[np.float32]]
    actions: list[NDArray[np.floating]]
    source: str


def from_dataset(dataset: Dataset, shown: int | None = None) -> Examples | None:
    """Parts of at most 100 training episodes, about 10,000 states in all.

    Parts of long episodes begin at different times of theirs, so that starts don't prevail.

    Args:
        dataset: the data set.
        shown: the number of an episode that is left out.

    Returns:
        The examples; None if there is no such episode.
    """
    lengths = dataset.episodes["length"]
    if np.count_nonzero(lengths) < 2:
        return None
    numbers = dataset.split_episodes().train
    chosen = sample(numbers[(numbers != shown) & (lengths[numbers] > 0)], _EPISODES)
    if not len(chosen):
        return None
    most = max(_SHORTEST, _ROWS // len(chosen))
    observations, actions = [], []
    for i, number in enumerate(chosen.tolist()):
        episode = dataset.episode(number)
        start = max(0, len(episode) - most) * i // len(chosen)
        part = slice(start, start + most)
        observation = np.asarray(episode["observation"][part])
        if np.isfinite(observation).all():
            observations.append(observation)
            actions.append(np.asarray(episode["action"][part])[:-1])
    if not observations:
        return None
    count = f"{len(observations)} training episodes" if len(observations) > 1 else "one episode"
    return Examples(observations, actions, f"{count} of {dataset.folder}")


class Forecaster:
    """Predicts the code at several horizons, and reads the state from it.

    The change of the code over k steps is a ridge regression on the code, the first k actions, and
    200 random ReLU features of both (extreme learning machine, Huang et al. 2006): nonlinear, and
    fitted at once. Windows in which an angle jumps by a turn are left out. The state is read from
    what the encoder decodes or, where it can't decode, by a ridge regression on the code.

    Args:
        encoder: of the code.
        task: of the examples.
        examples: what is fitted to.

    Attributes:
        names: of the state's columns.
        horizons: those that enough of the examples reach.
    """

    def __init__(self, encoder: BaseEncoder, task: Task, examples: Examples):
        latents = [encode(encoder, rows) for rows in examples.observations]
        self.names = list(state(task, examples.observations[0][:1]))
        self._predictors: dict[int, Predictor] = {}
        for ahead in HORIZONS:
            parts = zip(latents, examples.actions, examples.observations, strict=True)
            some = [windows(*part, task, ahead) for part in parts if len(part[1]) >= ahead]
            if sum(len(change) for _, change in some) >= _FEWEST:
                inputs, change = map(np.concatenate, zip(*some, strict=True))
                self._predictors[ahead] = _nonlinear(inputs, change)
        self.horizons = list(self._predictors)
        self._encoder, self._task = encoder, task
        if not encoder.can_decode:
            wanted = [columns(task, rows) for rows in examples.observations]
            self._read = ridge(np.concatenate(latents), np.concatenate(wanted))

    def read(self, latent: Array, observation: NDArray[Any]) -> Array:
        """The states read from codes: (n, columns) from (n, l).

        Where a code doesn't tell where the robot is, it stands and heads as in observations (n, d).
        """
        if not self._encoder.can_decode:
            return self._read(latent)
        return columns(self._task, decode(self._encoder, self._task, latent, observation))

    def __call__(
        self, latent: Array, observation: NDArray[Any], actions: NDArray[Any], ahead: int
    ) -> Array:
        """The states read from the codes (n, columns) that many steps after codes (n, l).

        Args:
            latent: the codes.
            observation: that they are of, (n, d).
            actions: from then on, (n, at least as many steps, m); later ones don't count.
            ahead: one of the horizons.
        """
        inputs = np.hstack((latent, actions[:, :ahead].reshape(len(latent), -1)))
        return self.read(latent + self._predictors[ahead](inputs), observation)


def encode(encoder: BaseEncoder, observation: NDArray[np.float32]) -> Array:
    """Codes (n, l) of observations (n, d)."""
    return np.asarray(encoder.encode(observation), np.float64)


def decode(
    encoder: BaseEncoder, task: Task, latent: NDArray[Any], observation: NDArray[Any]
) -> Array:
    """Observations (n, d) from codes (n, l); where codes don't tell a place, that of others."""
    decoded = encoder.decode(latent).astype(np.float64)
    return placed(task, decoded, observation) if encoder.not_decoded else decoded


def columns(task: Task, observation: NDArray[Any]) -> Array:
    """The state (n, columns) of observations (n, d)."""
    return np.stack(list(state(task, observation).values()), axis=1)


def next_actions(action: NDArray[Any], count: int) -> NDArray[Any]:
    """The actions from each step on (n - count + 1, count, m), of actions (n, m)."""
    return sliding_window_view(action, count, axis=0).swapaxes(1, 2)


def windows(
    latent: Array, action: NDArray[Any], observation: NDArray[Any], task: Task, ahead: int
) -> tuple[Array, Array]:
    """All windows of part of an episode but those in which an angle jumps.

    Args:
        latent: codes, (n + 1, l).
        action: (n, m), n at least `ahead`.
        observation: (n + 1, d).
        task: which says what is an angle.
        ahead: steps from now to then, k.

    Returns:
        The code now with the actions until then, (w, l + k * m), and the code's change, (w, l).
    """
    angles = [feature.is_full_turn for feature in task.features]
    turned = np.abs(observation[ahead:, angles] - observation[:-ahead, angles])
    smooth = (turned <= np.pi).all(axis=1)
    actions = next_actions(action, ahead)[smooth]
    now = latent[:-ahead][smooth]
    inputs = np.hstack((now, actions.reshape(len(now), -1)))
    return inputs, latent[ahead:][smooth] - now


def _nonlinear(inputs: Array, wanted: Array) -> Predictor:
    """A ridge regression on inputs (n, p) and random ReLU features of them, as a map."""
    mean, deviation = inputs.mean(axis=0), inputs.std(axis=0)
    factor = np.where(deviation > 0, 1 / np.where(deviation > 0, deviation, 1), 0)
    random = np.random.default_rng(0)
    weight = random.normal(size=(len(mean), _HIDDEN)) / np.sqrt(len(mean))
    bias = random.uniform(-1, 1, _HIDDEN)

    def widened(values: Array) -> Array:
        standard = np.clip((values - mean) * factor, -_LIMIT, _LIMIT)
        return np.hstack((standard, np.maximum(standard @ weight + bias, 0)))

    predict = ridge(widened(inputs), wanted)
    return lambda values: predict(widened(values))


def explained(predicted: Array, true: Array) -> Array:
    """R^2 of each column, (columns,); NaN of one that doesn't vary."""
    residual = np.square(predicted - true).sum(axis=0)
    variation = np.square(true - true.mean(axis=0)).sum(axis=0)
    return np.where(variation > 0, 1 - residual / np.where(variation > 0, variation, 1), np.nan)


def held(task: Task, count: int, steps: int) -> dict[str, Array]:
    """All actions held at their lowest, midway and highest, (count, steps, m) each."""
    low, high = np.asarray(task.action_low), np.asarray(task.action_high)
    values = {"held_low": low, "held_midway": (low + high) / 2, "held_high": high}
    return {name: np.tile(value, (count, steps, 1)) for name, value in values.items()}
