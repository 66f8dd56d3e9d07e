"""What forecasts and slow directions are fitted to: parts of episodes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset
from jbrep.dataset.scaled import sample
from jbrep.play.rollout import Rollout

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


def from_rollout(rollout: Rollout) -> Examples:
    """The episode that is shown, where there is nothing else."""
    return Examples([rollout.observation], [rollout.action], "this same episode")


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
    ends = np.cumsum(lengths, dtype=np.int64)
    numbers = np.unique(np.searchsorted(ends, dataset.split().train, side="right"))
    chosen = sample(numbers[numbers != shown], _EPISODES)
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
