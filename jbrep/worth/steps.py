"""Steps to learn control from: what was seen, done and earned, with actions that are held."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset
from jbrep.envs.recording import Recording
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError

_LEVELS, _DRAWN = 11, 32  # actions that are tried: of one number, and of several
_NUMBERS = 300_000  # steps times actions, at most: values that are computed at once


class Transitions(NamedTuple):
    """n steps, each of several control steps in which an action is held.

    Attributes:
        observation: before each, (n, d) in physical units.
        action: the mean action in it, scaled to [-1, 1], (n, k).
        reward: the mean reward of its control steps, (n,).
        next_observation: the observation after it, (n, d).
        continues: 0 where a state ended the episode in it, else 1, (n,).
        first: whether it begins an episode, (n,).
    """

    observation: NDArray[np.float32]
    action: NDArray[np.float32]
    reward: Array
    next_observation: NDArray[np.float32]
    continues: Array
    first: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.reward)


class _Episode(NamedTuple):
    """An episode of T control steps."""

    observation: NDArray[np.float32]  # (T + 1, d)
    action: NDArray[np.floating]  # (T, k) in the task's units
    reward: NDArray[np.floating]  # (T,)
    terminated: bool


def candidates(task: Task) -> NDArray[np.float32]:
    """Actions to try, scaled to [-1, 1], (m, k): a grid of one number, else a fixed draw."""
    if task.action_size == 1:
        return np.linspace(-1, 1, _LEVELS, dtype=np.float32)[:, None]
    drawn = np.random.default_rng(0).uniform(-1, 1, (_DRAWN, task.action_size))
    return np.concatenate((np.zeros((1, task.action_size)), drawn)).astype(np.float32)


def most(task: Task) -> int:
    """How many held steps to learn from, at most."""
    return _NUMBERS // len(candidates(task))


def stored(data: Dataset, episodes: NDArray[np.int64], hold: int, limit: int) -> Transitions:
    """Held steps of some episodes of a data set, in their order, of as many as reach a limit.

    Raises:
        InputError: there are no rewards, or no episode is as long as an action is held.
    """
    data["reward"]  # says what to do if there are none

    found, count = list[Transitions](), 0
    for number in episodes.tolist():
        if count >= limit:
            break
        if len(each := data.episode(number)) >= hold:
            seen = np.concatenate((each["observation"], each.record["final_observation"][None]))
            ended = bool(each.record["terminated"])
            played = _Episode(seen, each["action"], each["reward"], ended)
            found.append(_held(played, data.task, hold))
            count += len(found[-1])
    if not found:
        raise InputError(
            f"no episode of {data.folder} has {hold} steps, for which an action is held: nothing "
            "can be learned from them"
        )
    return joined(found)


def recorded(recording: Recording, task: Task, hold: int) -> list[Transitions]:
    """Held steps of each episode that was just played, if it is as long as an action is held."""
    return [
        _held(
            _Episode(
                recording.observation[: length + 1, lane],
                recording.action[:length, lane],
                recording.reward[:length, lane],
                bool(recording.terminated[lane]),
            ),
            task,
            hold,
        )
        for lane, length in enumerate(recording.length.tolist())
        if length >= hold
    ]


def joined(parts: Sequence[Transitions]) -> Transitions:
    """All steps of several, one after the other."""
    return Transitions(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _held(episode: _Episode, task: Task, hold: int) -> Transitions:
    """An episode as steps of `hold` control steps each; what is left at its end is not used.

    A state that ends the episode is in its last step, which begins later than the others would.
    """
    steps = len(episode.reward)
    starts = np.arange(0, steps - hold + 1, hold)
    if episode.terminated and starts[-1] + hold < steps:
        starts = np.append(starts, steps - hold)
    within = starts[:, None] + np.arange(hold)
    continues = np.ones(len(starts))
    continues[-1] -= episode.terminated
    return Transitions(
        observation=episode.observation[starts],
        action=task.scale_action(episode.action[within].mean(axis=1)).astype(np.float32),
        reward=episode.reward[within].mean(axis=1, dtype=np.float64),
        next_observation=episode.observation[starts + hold],
        continues=continues,
        first=starts == 0,
    )
