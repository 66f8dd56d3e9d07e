"""Controlled forward prediction: what a latent and the next actions say of what comes next."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.coordinates import wrapped
from jbrep.dataset import Column, ScaledDataset
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.task import Task
from jbrep.evaluation.evaluation import Judged, Prediction, Scalar, Score, diagnostic
from jbrep.evaluation.held_out import HeldOut, Rows, explained, sample_rows
from jbrep.evaluation.regression import Predictor, Problem
from jbrep.training.windows import first_rows

Matters = NDArray[np.float64] | None

HORIZONS = (1, 5, 10, 20)  # steps ahead
_ROWS = {"train": 100_000, "test": 50_000}  # at most
_SHARE = 0.6  # of a network's usual steps, for the changes: more would gain little
_USUAL = 0.5  # the share of rows that must have as many rows after them


class Steps(NamedTuple):
    """Rows with what follows each of them, at some number of steps k."""

    rows: Rows  # (n,)
    observation: NDArray[np.float32]  # now, (n, d)
    action: NDArray[Any]  # the next k actions, (n, k * m)
    wanted: NDArray[np.float32]  # each feature's `changes` and the mean reward, (n, d + 1)

    def inputs(self, encoder: BaseEncoder) -> NDArray[Any]:
        """Latents and actions side by side, (n, l + k * m)."""
        return np.hstack((encoder.encode(self.observation), self.action))


def prediction(
    encoder: BaseEncoder,
    held_out: HeldOut,
    predictors: Mapping[int, Predictor],
    matters: Matters = None,
) -> dict[str, Prediction]:
    """R^2 of each feature's change over k steps, and of the mean reward over them, by k.

    Predicted nonlinearly from the latent and the next k actions, and no later ones; fitted to a
    sample of at most 100,000 training rows, judged on one of at most 50,000 held-out rows, fewer of
    wide robots. `mean` is that over the features that change; `rewarded` likewise, but weighted by
    how much each matters to the reward, (d,), if that is known.
    """
    names = held_out.data.task.feature_names
    means = [np.append(each, 0.0) for each in (np.ones(len(names)), matters) if each is not None]
    results = {}
    for ahead, predictor in predictors.items():
        steps = held_out.once(following, "test", ahead)
        each = explained(
            predictor(steps.inputs(encoder)),
            steps.wanted,
            steps.rows,
            held_out.sums,
            widths=[1] * (len(names) + 1),
            means=means,
        )
        results[str(ahead)] = Prediction(
            features=dict(zip(names, each, strict=False)),
            reward=each[len(names)],
            mean=each[len(names) + 1],
            rewarded=None if matters is None else each[-1],
        )
    return results


@diagnostic(
    Scalar("forward", "R² of the features' change over 10 steps", is_first=True),
    Scalar(
        "rewarded", "R² of the change over 10 steps of what the reward depends on", is_first=True
    ),
    Scalar("reward", "R² of the mean reward of 10 steps", is_first=True),
    Scalar("forward_1", "R² of the features' change over 1 step"),
    Scalar("forward_5", "the same over 5 steps"),
    Scalar("forward_20", "the same over 20 steps"),
)
def of_prediction(e: Judged) -> list[Score | None]:
    """As `prediction` has them; 10 steps, or as near to that as episodes allow."""
    others = (e.known.prediction.get(str(steps)) for steps in (1, 5, 20))
    first = [e.known.ahead(what) for what in ("mean", "rewarded", "reward")]
    return [*first, *(each.mean if each else None for each in others)]


def problems(encoder: BaseEncoder, held_out: HeldOut) -> dict[int, tuple[Problem, Problem]]:
    """By the number of steps ahead: the features' changes, and the reward.

    The reward has a network of its own: beside many features a rare one would hardly be learnt.
    """
    problems = {}
    for ahead in usual_horizons(held_out.data):
        steps = held_out.once(following, "train", ahead)
        inputs, (changed, reward) = steps.inputs(encoder), np.split(steps.wanted, [-1], axis=1)
        problems[ahead] = Problem(inputs, changed, share=_SHARE), Problem(inputs, reward)
    return problems


def usual_horizons(data: ScaledDataset) -> list[int]:
    """The numbers of steps that at least half the rows, training and held out, have after them."""
    ends = np.cumsum(data.dataset.episodes["length"], dtype=np.int64)
    later = [ends[np.searchsorted(ends, r, side="right")] - 1 - r for r in (data.train, data.test)]
    return [h for h in HORIZONS if all((after >= h).mean() >= _USUAL for after in later)]


def following(held_out: HeldOut, part: str, ahead: int) -> Steps:
    """A sample of the rows of `train` or `test` that have so many rows after them."""
    data = held_out.data
    task, dataset, rows = data.task, data.dataset, getattr(data, part)
    width = 2 * task.size + ahead * task.action_size
    chosen = sample_rows(rows[first_rows(data, rows, ahead)], _ROWS[part], width)
    observation = dataset["observation"]
    steps = chosen[:, None] + np.arange(ahead)
    reward = data.rewards(steps).mean(axis=1, dtype=np.float64)
    changed = changes(task, observation, chosen, ahead)
    wanted = np.hstack((changed, reward[:, None])).astype(np.float32)
    action = dataset["action"][steps].reshape(len(chosen), -1)
    return Steps(chosen, observation[chosen], action, wanted)


def changes(
    task: Task, observation: Column | NDArray[Any], rows: NDArray[np.int64], ahead: int
) -> NDArray[np.float64]:
    """What features (d,) of all rows change by in so many steps after some rows, (n, d).

    Angles by all that they turn, each step the shorter way round: the difference of two angles
    jumps where a joint turns more than half round, and hardly anything could predict it.
    """
    change = np.subtract(observation[rows + ahead], observation[rows], dtype=np.float64)
    angles = [feature.is_full_turn for feature in task.features]
    if any(angles):
        seen = (observation[rows + step][:, angles] for step in range(ahead + 1))
        turns = (wrapped(np.subtract(b, a, dtype=np.float64)) for a, b in pairwise(seen))
        change[:, angles] = sum(turns)
    return change
