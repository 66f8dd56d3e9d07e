"""A data set prepared for learning representations: split by episode, scaled to [-1, 1]."""

import math
from collections.abc import Collection, Iterator
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from jbrep.coordinates import Coordinates
from jbrep.dataset.reader import Dataset
from jbrep.dataset.scaling import EXTREMA, NOMINAL, extrema, fit_scaler
from jbrep.envs.task import Feature


def sample(rows: NDArray[Any], most: int) -> NDArray[Any]:
    """At most `most` of the rows, drawn at random, always the same ones, in order."""
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


class Moments(NamedTuple):
    """Mean and covariance, which is all that linear methods need."""

    mean: NDArray[np.float64]  # (d,)
    covariance: NDArray[np.float64]  # (d, d)


class ScaledDataset:
    """Observations scaled to [-1, 1] by the extrema of the training part, or as `rescaled` says.

    Attributes:
        dataset: the data set itself.
        task: the task of the observations.
        train: sorted rows of 80 % of the episodes.
        test: sorted rows of the others.
        scaler: fitted to the training rows only.
        scaling: how, a key of jbrep.dataset.scaling.SCALINGS.
        used: places of the scaled numbers that a row has; all of them unless some are left out.
    """

    def __init__(self, dataset: Dataset):
        self.dataset = dataset
        self.task = dataset.task
        self.train, self.test = dataset.split()
        self.scaler = dataset.fit_scaler(self.train)
        self.scaling = EXTREMA
        self.used = np.arange(self.scaler.size)

    @classmethod
    def of(cls, data: "ScaledDataset | Dataset | str | Path") -> "ScaledDataset":
        """What a user gives as data: it may be a data set, or its folder."""
        if isinstance(data, ScaledDataset):
            return data
        return cls(data if isinstance(data, Dataset) else Dataset(data))

    def rescaled(
        self,
        scaling: str = EXTREMA,
        coordinates: Coordinates | None = None,
        clip: float | None = None,
        without: Collection[str] = (),
    ) -> "ScaledDataset":
        """The same rows and split, scaled otherwise, see `fit_scaler`.

        Rows then are without some features or coordinates, or groups of such coordinates.
        """
        other = copy(self)
        for found in ("moments", "constant_features"):
            other.__dict__.pop(found, None)
        column = self.dataset["observation"]
        other.scaling = scaling
        other.scaler = fit_scaler(scaling, self.task, column, self.train, coordinates, clip)
        left_out = set(other.scaler.places(without, self.task))
        other.used = np.array([i for i in range(other.scaler.size) if i not in left_out], int)
        return other

    def __repr__(self) -> str:
        return f"ScaledDataset({self.dataset!r}, {len(self.train):,} rows to train on)"

    @property
    def size(self) -> int:
        """Length of a scaled row."""
        return len(self.used)

    @property
    def features(self) -> tuple[Feature, ...]:
        """What each number of a scaled row is: a feature of the observation, or a coordinate."""
        every = self.scaler.features(self.task)
        return tuple(every[i] for i in self.used)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of these."""
        return tuple(feature.name for feature in self.features)

    @cached_property
    def constant_features(self) -> tuple[str, ...]:
        """Names of the numbers of a scaled row that are the same in all training rows."""
        low, high = self.scaler.low[self.used], self.scaler.high[self.used]
        if self.scaling == NOMINAL:  # the only one whose ranges aren't of these rows
            low, high = extrema(self.chunks(self.train))
        return tuple(np.array(self.names)[low == high].tolist())

    @cached_property
    def reward_varies(self) -> bool:
        """Whether there are rewards, and not all training rows have the same."""
        if self.dataset.manifest.settings.unrewarded:
            return False
        parts = self.dataset["reward"].parts(self.train)
        first = self.dataset["reward"][self.train[0]]
        return any((part != first).any() for part in parts)

    def rewards(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Rewards of the rows, of the same shape, within [-1, 1]; all 0 where the data have none.

        They are in a unit that is a power of two, so that no digit is lost.
        """
        if self.dataset.manifest.settings.unrewarded:
            return np.zeros(rows.shape, np.float32)
        return np.ldexp(self.dataset["reward"][rows], -self._reward_exponent)

    @cached_property
    def _reward_exponent(self) -> int:
        """Of the least power of two that no reward of the training part is above."""
        parts = self.dataset["reward"].parts(self.train)
        most = max(float(np.abs(part).max()) for part in parts)
        return math.ceil(math.log2(most)) if most else 0

    def observations(self, rows: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
        """Observations of the rows in physical units, in order, in chunks (n, d)."""
        return self.dataset["observation"].parts(rows)

    def scale(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Observations (n, d) in physical units as scaled rows (n, size)."""
        scaled: NDArray[np.float32] = self.scaler.scale(observations)
        return scaled if self.size == self.scaler.size else scaled[:, self.used]

    def chunks(self, rows: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
        """Scaled rows, in order, in chunks (n, size)."""
        return map(self.scale, self.observations(rows))

    def load(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Scaled rows, (n, size)."""
        loaded = np.empty((len(rows), self.size), np.float32)
        start = 0
        for chunk in self.chunks(rows):
            loaded[start : start + len(chunk)] = chunk
            start += len(chunk)
        return loaded

    def actions(self, rows: NDArray[np.int64], dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """Actions of the rows, scaled to [-1, 1] by their bounds in that type, (n, k)."""
        bounds = self.task.action_low, self.task.action_high
        low, high = (np.asarray(bound, dtype) for bound in bounds)
        half_width = np.where(high > low, (high - low) / 2, 1)  # 1 of what can't move
        return (self.dataset["action"][rows] - (high + low) / 2) / half_width.astype(dtype)

    @cached_property
    def moments(self) -> Moments:
        """Mean and covariance of the scaled training rows."""
        total, products = np.zeros(self.size), np.zeros((self.size, self.size))
        for chunk in self.chunks(self.train):
            rows = chunk.astype(np.float64)
            total += rows.sum(axis=0)
            products += rows.T @ rows
        mean = total / len(self.train)
        return Moments(mean, products / len(self.train) - np.outer(mean, mean))
