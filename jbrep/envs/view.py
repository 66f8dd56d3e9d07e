"""What is seen of an environment that gives more: some of its features, and their history."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import MAX_FEATURES, Array, Task, View
from jbrep.errors import InputError, matching


def with_view(task: Task, hidden: Iterable[str] = (), history: int = 1) -> Task:
    """The task seen without some features, or with those of its last steps, or both.

    The observation is what isn't hidden of the current state, then of the state before, and so on,
    then the last action, the one before, and so on: `speed`, `speed.1`, `action.1`. Before an
    episode's start, it stood still: its first state, and actions of 0 or the nearest to it.

    Hidden are names or patterns, as in `velocity_*`, of features or groups; of the history counts
    the current state, too.
    """
    if task.view:
        raise InputError(f"some of {task.name} is hidden, or seen with its past, already")
    names, groups = task.feature_names, [each.group or each.name for each in task.features]
    places = matching(hidden, names, groups, f"{task.name} has no feature")
    left_out = tuple(names[i] for i in sorted(places))
    view = View(features=task.features, hidden=left_out, history=history)
    if not view.hidden and history == 1:
        return task
    seen = view.seen(task.action_low, task.action_high)
    if len(seen) > MAX_FEATURES:
        raise InputError(
            f"a history of {history} has {len(seen):,} numbers: {MAX_FEATURES:,} may be"
        )
    return task.replace(name=f"{task.name}{view.suffix}", features=seen, view=view)


class Window:
    """What n robots have shown of late, from which observations with a history are made.

    Args:
        task: with a view.
        num_envs: n.
        places: where the features that are seen stand in what is given, of D numbers.
    """

    def __init__(self, task: Task, num_envs: int, places: Sequence[int]):
        view = task.view
        assert view
        self._places = np.array(places)
        self._states = np.zeros((num_envs, view.history, len(self._places)))
        self._rest = task.rest
        self._actions = np.zeros((num_envs, view.history - 1, task.action_size))

    def begin(self, indices: Sequence[int] | NDArray[np.int64], given: NDArray[Any]) -> Array:
        """What is seen in all, (n, d), after an episode began in some; given is (n, D)."""
        self._states[indices] = given[indices][:, None, self._places]
        self._actions[indices] = self._rest
        return self._seen()

    def step(self, moved: NDArray[np.bool_], actions: NDArray[Any], given: NDArray[Any]) -> Array:
        """What is seen in all environments, (n, d), after a step of those that moved, (n,)."""
        for past, now in ((self._states, given[:, self._places]), (self._actions, actions)):
            if past.shape[1]:
                past[moved, 1:] = past[moved, :-1]
                past[moved, 0] = now[moved]
        return self._seen()

    def _seen(self) -> Array:
        n = len(self._states)
        return np.hstack((self._states.reshape(n, -1), self._actions.reshape(n, -1)))


class ViewedBatch:
    """A batch of environments, as `Environments` steps one, of which a task's view is seen."""

    def __init__(self, batch: Any, task: Task, num_envs: int):
        assert task.view
        self._batch = batch
        self._window = Window(task, num_envs, task.view.places)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._batch, name)

    def reset(self, seed: Any, options: Mapping[str, Any]) -> tuple[Array, Any]:
        given, info = self._batch.reset(seed=seed, options=options)
        return self._window.begin(np.flatnonzero(options["reset_mask"]), given), info

    def step(self, actions: Array) -> tuple[Any, ...]:
        given, *others = self._batch.step(actions)
        moved = ~getattr(self._batch, "lost", np.zeros(len(given), np.bool_))
        return self._window.step(moved, actions, given), *others


def seen_in_episodes(
    task: Task,
    observation: NDArray[np.float32],
    action: NDArray[np.float32],
    final: NDArray[np.float32],
    length: NDArray[np.int32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What is seen in recorded episodes, before each step (N, d) and at the end of each (n, d).

    The environment gave observations (N, D) before actions (N, k), and final ones (n, D) in
    episodes of n lengths, N in all.
    """
    view = task.view
    assert view
    ends = np.cumsum(length)
    states = np.insert(observation, ends, final, axis=0)[:, view.places]
    actions = np.insert(action, ends, task.rest, axis=0)
    last = ends + np.arange(len(length))  # rows of the final states
    first = np.repeat(last - length, length + 1)
    row = np.arange(len(states))
    past = [actions[row - lag] for lag in range(1, view.history)]
    for lag, taken in enumerate(past, 1):
        taken[row - lag < first] = task.rest
    parts = [states[np.maximum(row - lag, first)] for lag in range(view.history)] + past
    seen = np.hstack(parts).astype(np.float32)
    return np.delete(seen, last, axis=0), seen[last]
