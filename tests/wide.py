"""A made-up data set of a wide robot, as far as encoders look at one."""

from itertools import accumulate
from types import SimpleNamespace

import numpy as np

from jbrep.dataset import Column, Dataset, ScaledDataset


class WideDataset:
    """Features near a plane of few dimensions, in episodes of these lengths.

    Feature 0 is constant, feature 1 spreads over 1e8 and feature 2 over 1e-8.

    Args:
        lengths: rows of each episode.
        features: of an observation, at least 3.
        actions: numbers of an action.
        name: of the task.
        folder: for a file of the observations, to be mapped; None keeps them in memory.
        unit, bounded, half_range: of every feature.
    """

    split, fit_scaler = Dataset.split, Dataset.fit_scaler

    def __init__(
        self,
        lengths,
        features=348,
        actions=17,
        name="Humanoid-v5",
        folder=None,
        unit="",
        bounded=False,
        half_range=None,
    ):
        low, high = (None, None) if half_range is None else (-half_range, half_range)
        described = [
            SimpleNamespace(name=f"obs_{i}", unit=unit, low=low, high=high, bounded=bounded)
            for i in range(features)
        ]
        names = tuple(f.name for f in described)
        self.task = SimpleNamespace(
            name=name, features=described, size=features, feature_names=names
        )
        self.episodes = {"length": np.array(lengths), "seed": np.arange(len(lengths))}
        self.folder = folder
        settings = SimpleNamespace(policy={"kind": "uniform"}, seed=0)
        self.manifest = SimpleNamespace(fingerprint="wide", settings=settings)
        count = sum(lengths)
        action = np.random.default_rng(1).uniform(-1, 1, (count, actions)).astype(np.float32)
        self._columns = {"observation": self._observations(count, features), "action": action}

    def _observations(self, count, features):
        if self.folder is None:
            rows = np.empty((count, features), np.float32)
        else:
            path = self.folder / "observations"
            rows = np.memmap(path, np.float32, "w+", shape=(count, features))
        random = np.random.default_rng(0)
        plane = random.normal(size=(5, features)).astype(np.float32)
        for start in range(0, count, 1000):
            part = rows[start : start + 1000]
            part[:] = random.normal(size=(len(part), 5)).astype(np.float32) @ plane
            part[:, 0] = 3
            part[:, 1:3] *= np.float32([1e8, 1e-8])
        return rows

    def __getitem__(self, name):
        values = self._columns[name]
        return Column(lambda shard: values, [len(values)], values.dtype, values.shape[1:])

    def __len__(self):
        return list(accumulate(self.episodes["length"]))[-1]


def wide(lengths, **options):
    """The same, split and scaled."""
    return ScaledDataset(WideDataset(lengths, **options))
