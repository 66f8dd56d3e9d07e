"""A data set as representations are learned from it: split by episode, scaled to [-1, 1]."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.reader import Dataset
from jbrep.errors import InputError


def sample(rows: NDArray[Any], most: int) -> NDArray[Any]:
    """At most so many of them, in order; always the same draw, and of any step of an episode."""
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


class Moments(NamedTuple):
    """What linear methods need to know of the training part."""

    mean: NDArray[np.float64]  # (d,)
    covariance: NDArray[np.float64]  # (d, d)


class ScaledDataset:
    """Observations scaled to [-1, 1] by the extrema of the training part.

    Attributes:
        dataset: where they are.
        train: sorted rows of 80 % of the episodes.
        test: sorted rows of the others.
        scaler: fitted on the training rows alone.

    Raises:
        InputError: fewer than two episodes, or a number that is not finite.
    """

    def __init__(self, dataset: Dataset):
        self.dataset = dataset
        self.task = dataset.task
        self.train, self.test = dataset.split()
        self.scaler = dataset.fit_scaler(self.train)
        unseen = dataset.fit_scaler(self.test)
        extrema = (self.scaler.low, self.scaler.high, unseen.low, unseen.high)
        broken = np.asarray(~np.isfinite(extrema).all(axis=0))
        if broken.any():
            bad = ", ".join(self._names(broken))
            raise InputError(
                f"{dataset.folder} holds numbers that aren't finite in {bad}: look with jbrep data "
                "verify"
            )

    @property
    def constant_features(self) -> tuple[str, ...]:
        """Features that never vary over the training rows; they are scaled to 0."""
        return self._names(self.scaler.low == self.scaler.high)

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(np.array(self.task.feature_names)[which].tolist())

    def observations(self, rows: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
        """Observations of those rows in physical units, in order, some (n, d) at a time."""
        return self.dataset["observation"].parts(rows)

    def chunks(self, rows: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
        """The same, scaled."""
        return map(self.scaler.scale, self.observations(rows))

    def load(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Scaled observations of those rows, (n, d)."""
        loaded = np.empty((len(rows), self.task.size), np.float32)
        start = 0
        for chunk in self.chunks(rows):
            loaded[start : start + len(chunk)] = chunk
            start += len(chunk)
        return loaded

    @cached_property
    def moments(self) -> Moments:
        """Mean and covariance of the training rows."""
        total, products = np.zeros(self.task.size), np.zeros((self.task.size, self.task.size))
        for chunk in self.chunks(self.train):
            rows = chunk.astype(np.float64)
            total += rows.sum(axis=0)
            products += rows.T @ rows
        mean = total / len(self.train)
        return Moments(mean, products / len(self.train) - np.outer(mean, mean))
