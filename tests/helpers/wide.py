"""A made-up data set of a wide robot, as far as encoders look at one."""

from types import SimpleNamespace

import numpy as np

from jbrep.dataset import Column, Dataset, ScaledDataset
from jbrep.envs import Feature, Task

SPREADS = {0: 0, 1: 1e8, 2: 1e-8}  # of the first features; about 1 of the others
PLANE = 5  # dimensions in which nearly all variation lies


def make_feature(name, unit="", low=None, high=None, bounded=False, kind="scalar"):
    """A feature as a task has it."""
    return Feature(name, unit, low, high, bounded, kind=kind)


def make_task(features, name="Humanoid-v5"):
    """What encoders and diagnostics look at of a task."""
    return Task(
        id=name,
        name=name,
        features=tuple(features),
        action_low=(-1.0,) * 17,
        action_high=(1.0,) * 17,
        max_episode_steps=1000,
    )


class WideDataset:
    """A Dataset of features near a plane, with actions of 17 numbers.

    Args:
        lengths: rows of each episode.
        features: in an observation.
        folder: for a file of the observations, which is mapped; None keeps them in memory.
    """

    split = Dataset.split
    fit_scaler = Dataset.fit_scaler

    def __init__(self, lengths, features=348, folder=None):
        self.task = make_task([make_feature(f"obs_{i}") for i in range(features)])
        self.episodes = {"length": np.array(lengths), "seed": np.arange(len(lengths))}
        self.folder = folder
        settings = SimpleNamespace(policy={"kind": "uniform"}, seed=0, unrewarded=False)
        self.manifest, self.fingerprint = SimpleNamespace(settings=settings), "wide"
        random = np.random.default_rng(0)
        self.arrays = {
            "observation": self._observations(sum(lengths), features, random),
            "action": random.uniform(-1, 1, (sum(lengths), 17)).astype(np.float32),
            "reward": np.zeros(sum(lengths), np.float32),
        }

    def _observations(self, count, features, random):
        if self.folder is None:
            rows = np.empty((count, features), np.float32)
        else:
            rows = np.memmap(self.folder / "rows", np.float32, "w+", shape=(count, features))
        plane = random.normal(size=(PLANE, features))
        for start in range(0, count, 1000):
            part = rows[start : start + 1000]
            noise = 0.1 * random.normal(size=part.shape)
            part[:] = random.normal(size=(len(part), PLANE)) @ plane + noise
            for place, spread in SPREADS.items():
                part[:, place : place + 1] *= np.float32(spread)
        return rows

    def __getitem__(self, name):
        values = self.arrays[name]
        return Column(lambda shard: values, [len(values)], values.dtype, values.shape[1:])


def wide(lengths, **options):
    """The same, split and scaled."""
    return ScaledDataset(WideDataset(lengths, **options))
