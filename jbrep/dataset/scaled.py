"""A data set prepared for learning representations: split by episode, scaled to [-1, 1]."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.reader import Dataset
from jbrep.errors import InputError


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
    """Observations scaled to [-1, 1] by the extrema of the training part.

    Attributes:
        dataset: the data set itself.
        task: the task of the observations.
        train: sorted rows of 80 % of the episodes.
        test: sorted rows of the others.
        scaler: fitted to the training rows only.

    Raises:
        InputError: fewer than two episodes, or numbers that aren't finite.
    """

    def __init__(self, dataset: Dataset):
        self.dataset = dataset
        self.task = dataset.task
        self.train, self.test = dataset.split()
        self.scaler = dataset.fit_scaler(self.train)
        unseen = dataset.fit_scaler(self.test)
        extrema = (self.scaler.low, self.scaler.high, unseen.low, unseen.high)
        not_finite = np.asarray(~np.isfinite(extrema).all(axis=0))
        if not_finite.any():
            bad = ", ".join(self._names(not_finite))
            raise InputError(
                f"{dataset.folder} has values that aren't finite in {bad}: run jbrep data verify"
            )

    def __repr__(self) -> str:
        return f"ScaledDataset({self.dataset!r}, {len(self.train):,} rows to train on)"

    @property
    def constant_features(self) -> tuple[str, ...]:
        """Features that are constant over the training rows; they are scaled to 0."""
        return self._names(self.scaler.low == self.scaler.high)

    def _names(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(np.array(self.task.feature_names)[which].tolist())

    def observations(self, rows: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
        """Observations of the rows in physical units, in order, in chunks (n, d)."""
        return self.dataset["observation"].parts(rows)

    def chunks(self, rows: NDArray[np.int64]) -> Iterator[NDArray[np.float32]]:
        """The same, scaled."""
        return map(self.scaler.scale, self.observations(rows))

    def load(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Scaled observations of the rows, (n, d)."""
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
