"""Readings that are missing in episodes that were made elsewhere: as lanes treat those of a robot.

See `jbrep.envs.task.Task` for what may become of them.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import Incoming, single
from jbrep.dataset.schema import UNKNOWN_SEED
from jbrep.envs.task import most_held
from jbrep.errors import InputError

Array = NDArray[Any]


def count_missing(episode: Incoming) -> int:
    """How many numbers of an episode aren't finite."""
    parts = (episode.observation, episode.action, episode.reward, episode.final)
    return sum(int((~np.isfinite(part)).sum()) for part in parts)


def without_missing(episode: Incoming, missing: str) -> Iterator[Incoming]:
    """An episode in which all numbers are finite, or the parts of it that are.

    Args:
        episode: of n steps.
        missing: skip leaves out the steps that aren't whole, and divides the episode there; hold:3
            has the last number instead, for at most 3 steps in a row; empty if there must be none.
    """
    count = count_missing(episode)
    if not count or not missing:
        check_numbers(episode)
        yield episode
    elif missing == "skip":
        yield from _whole_parts(episode._replace(missing=count))
    else:
        held = _held(episode, most_held(missing))
        yield held._replace(missing=count)


def check_numbers(episode: Incoming) -> None:
    """Make sure that 32 bits hold the numbers of an episode."""
    parts = {"observation": episode.observation, "final observation": episode.final[None]}
    for what, values in {**parts, "action": episode.action, "reward": episode.reward}.items():
        single(episode.where, what, values)


def _whole_parts(episode: Incoming) -> Iterator[Incoming]:
    """Those of consecutive steps from a whole observation to the next; the first has the count."""
    seen = np.concatenate((episode.observation, episode.final[None]))
    is_whole = np.asarray(np.isfinite(seen).all(axis=1))
    steps = is_whole[:-1] & is_whole[1:] & np.isfinite(episode.reward)
    steps &= np.isfinite(episode.action).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], steps, [False]))))
    for begin, end in edges.reshape(-1, 2).tolist():
        yield Incoming(
            where=episode.where,
            observation=seen[begin:end],
            action=episode.action[begin:end],
            reward=episode.reward[begin:end],
            final=seen[end],
            terminated=episode.terminated and end == len(steps),
            truncated=episode.truncated and end == len(steps),
            seed=episode.seed if begin == 0 else UNKNOWN_SEED,
            missing=episode.missing if begin == edges[0] else 0,
        )


def _held(episode: Incoming, most: int) -> Incoming:
    """The episode with the last numbers in place of missing ones; an action has none."""
    if not (whole := np.isfinite(episode.action).all(axis=1)).all():
        raise InputError(
            f"{episode.where} lacks its action at step {int(np.flatnonzero(~whole)[0])}, which "
            "can't be held: leave the episode out, or give --missing skip"
        )
    seen = np.concatenate((episode.observation, episode.final[None]))
    reward = np.concatenate(([0.0], episode.reward))  # with the observation after it
    rows = np.column_stack((seen, reward))
    number = np.arange(len(rows))[:, None]
    last = np.maximum.accumulate(np.where(np.isfinite(rows), number, -1))
    if len(wrong := np.argwhere((last < 0) | (number - last > most))):
        step, column = wrong[0]
        what = "the reward" if column == seen.shape[1] else f"feature {column}"
        is_first = last[step, column] < 0
        why = "with none before to hold" if is_first else f"beyond hold:{most} of the last one"
        raise InputError(
            f"{episode.where}: {what} is missing at step {step}, {why}: "
            f"{'' if is_first else 'hold it for longer, '}give --missing skip, or leave the "
            "episode out"
        )
    filled = np.take_along_axis(rows, last, axis=0)
    return episode._replace(
        observation=filled[:-1, :-1], final=filled[-1, :-1], reward=filled[1:, -1]
    )
