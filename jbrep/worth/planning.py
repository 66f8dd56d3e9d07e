"""Planning in a code: a model of the code and the reward, and a search of actions over it.

The search is the cross-entropy method (Rubinstein 1999; for control Chua et al. 2018, PETS): of
many drawn sequences of actions, the mean and deviation of the best are what the next are drawn by.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Array
from jbrep.evaluate.regression import Predictor, Problem, fit, ridge
from jbrep.worth.fitted import Actions, Choose, Coded, Codes

_HORIZON = 8  # held steps ahead
_DRAWN, _BEST, _ROUNDS = 48, 6, 3  # sequences, those that count, and how often
_BEGIN = 0.7  # deviation of the first draw
_LEAST = 0.05  # deviation later


class Model(NamedTuple):
    """What comes after a code and an action.

    Attributes:
        predict: codes and actions (n, l + k) to changes of the code, rewards and, where states
            ended episodes of the data, whether they go on, (n, l + 1) or (n, l + 2).
        low, high: of the codes that were seen, which predictions stay within, (l,).
    """

    predict: Predictor
    low: Codes
    high: Codes

    def step(self, codes: Codes, actions: Actions) -> tuple[Codes, Array, Array]:
        """The next codes (n, l), the rewards (n,), and the shares that go on after them, (n,)."""
        size = codes.shape[1]
        told = self.predict(np.hstack((codes, actions)))
        next_code = np.clip(codes + told[:, :size], self.low, self.high)
        ends = told.shape[1] > size + 1
        continues = np.clip(told[:, size + 1], 0, 1) if ends else np.ones(len(codes))
        return next_code.astype(np.float32), told[:, size], continues


def linear_model(steps: Coded) -> Model:
    """By ridge regression."""
    return _model(steps, ridge(*_told(steps)))


def network_model(steps: Coded) -> Model:
    """By a small network, as diagnostics have them."""
    (predict,) = fit([Problem(*_told(steps))])
    return _model(steps, predict)


def _told(steps: Coded) -> tuple[NDArray[Any], NDArray[Any]]:
    """What a model is given, (n, l + k), and what it is to predict, as `Model.predict` has it."""
    held = steps.held
    given = np.hstack((steps.code, held.action))
    ends = () if held.continues.all() else (held.continues,)
    return given, np.column_stack((steps.next_code - steps.code, held.reward, *ends))


def _model(steps: Coded, predict: Predictor) -> Model:
    return Model(predict, steps.next_code.min(axis=0), steps.next_code.max(axis=0))


def planned(model: Model, gamma: float, size: int) -> Choose:
    """What chooses the first of the best actions that are found.

    Args:
        model: that is searched.
        gamma: the discount of a held step.
        size: of an action, k.
    """

    def choose(codes: Codes) -> Actions:
        random, count = np.random.default_rng(0), len(codes)
        mean = np.zeros((count, 1, _HORIZON, size))
        deviation = np.full_like(mean, _BEGIN)
        for _ in range(_ROUNDS):
            drawn = random.normal(size=(1, _DRAWN, _HORIZON, size)) * deviation + mean
            drawn = np.clip(drawn, -1, 1)
            value = _worth(model, codes, drawn, gamma)
            best = np.argsort(-value, axis=1)[:, :_BEST, None, None]
            chosen = np.take_along_axis(drawn, best, axis=1)
            mean = chosen.mean(axis=1, keepdims=True)
            deviation = np.maximum(chosen.std(axis=1, keepdims=True), _LEAST)
        return mean[:, 0, 0].astype(np.float32)

    return choose


def _worth(model: Model, codes: Codes, drawn: Array, gamma: float) -> Array:
    """The discounted rewards of each sequence of actions (n, m, horizon, k) to its end, (n, m)."""
    count, many = drawn.shape[:2]
    flat = drawn.reshape(count * many, *drawn.shape[2:]).astype(np.float32)
    at, total, weight = np.repeat(codes, many, axis=0), np.zeros(len(flat)), np.ones(len(flat))
    for ahead in range(drawn.shape[2]):
        at, reward, continues = model.step(at, flat[:, ahead])
        total += weight * reward
        weight *= gamma * continues
    return total.reshape(count, many)
