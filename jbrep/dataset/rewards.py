"""Rewards of a user's own for data that exist already, by a function."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.columns import Array
from jbrep.envs.names import code_named
from jbrep.envs.task import Task
from jbrep.errors import InputError, refusing


def reward_function(code: str) -> Callable[[Array, Array], NDArray[np.float64]]:
    """A user's function of observations (n, d) and actions (n, k), for an episode's rewards (n,).

    It is named as module:function, and sees what the data set has, without offsets of features.
    """
    function = code_named(code, "reward")

    def rewards(observations: Array, actions: Array) -> NDArray[np.float64]:
        with refusing(f"the reward {code} fails"):
            made = np.asarray(function(observations.copy(), actions.copy()))
            given = made.astype(float, casting="same_kind")
        if given.shape != (len(actions),):
            raise InputError(
                f"the reward {code} gives an array of shape {given.shape} for {len(actions)} "
                f"steps: it must be ({len(actions)},)"
            )
        if len(wrong := np.flatnonzero(~(np.abs(given) <= np.finfo(np.float32).max))):
            raise InputError(
                f"the reward {code} gives {given[wrong[0]]} at step {wrong[0]} of an episode: it "
                "must be finite in 32 bits"
            )
        return given

    return rewards


def without_range(task: Task) -> Task:
    """The task with other rewards than its own: nothing is known of their range."""
    return task.replace(reward_low=None, reward_high=None, solved_return=None)
