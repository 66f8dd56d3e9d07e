"""Policies that agents are compared with: blind baselines, and the scripted ones."""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from jbrep.envs.task import Array, Task
from jbrep.jitterbug.tasks import jitterbug_task
from jbrep.play.sources import find_player
from jbrep.records.tables import as_in_tables
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.stats.labels import NO, UNCLEAR, YES, learnt
from jbrep.stats.scale import CONSTANT, LOOKING, RANDOM, STILL, best_blind
from jbrep.text import counted, interval, rounded

_POLICIES = {
    STILL: "still",
    CONSTANT: "constant:drive=0.75",  # of five, what moves the Jitterbug furthest
    RANDOM: "uniform",
    LOOKING: "heuristic",
}
_WORDS = {
    YES: "above the baselines",
    UNCLEAR: "not clearly above the baselines",
    NO: "not above the baselines",
}


def policies_of(task: Task) -> list[str]:
    """The names of the reference policies that a task has."""
    return [policy for policy in _POLICIES if policy != LOOKING or jitterbug_task(task)]


def play(policy: str, task: Task, episodes: int) -> list[float]:
    """Returns of a policy, of these or by name, in a task's first episodes, as tables have them."""
    one_by_one = None if task.reproducible else 1  # a robot may exist once
    returns = find_player(_POLICIES.get(policy, policy), task).returns(episodes, one_by_one)
    return [*map(as_in_tables, returns)]


class Beside(NamedTuple):
    """What a run's agent returns, beside policies that don't learn, from the same starts.

    Attributes:
        learnt: yes, no or unclear: whether it is above the best blind baseline.
        agent: text of `mean_text`.
        references: mean returns by policy.
    """

    learnt: str
    agent: str
    references: dict[str, float]

    def __str__(self) -> str:
        means = zip(self.references, rounded(*self.references.values()), strict=True)
        others = ", ".join(f"{name} {mean}" for name, mean in means)
        return f"{_WORDS[self.learnt]}: {self.agent}; from the same starts {others}"


def mean_text(task: Task, returns: Sequence[float] | Array) -> str:
    """The mean of returns with its interval: 31.9 [28.1, 35.7], mean and 95 % interval of 50 ..."""
    bounds = Bounds.of(task.return_floor, task.return_ceiling)
    mean = interval(mean_within(np.asarray(returns), bounds, LEVEL).tolist())
    return f"{mean}, mean and 95 % interval of {counted(len(returns), 'episode')}"


def beside(task: Task, returns: Sequence[float] | Array) -> Beside | None:
    """Compare a run's final returns with those of policies that don't learn, from its starts.

    Returns:
        None where the other policies can't be played.
    """
    played = dict[str, Array]()
    for policy in policies_of(task):
        with suppress(Exception):  # of an environment that isn't installed there are none
            played[policy] = np.array(play(policy, task, len(returns)))
    means = {policy: float(each.mean()) for policy, each in played.items()}
    best = best_blind(means)
    if best is None:
        return None
    bounds = Bounds.of(task.return_floor, task.return_ceiling)
    blind = mean_within(played[best], bounds, LEVEL)
    return Beside(learnt(np.asarray(returns), blind, bounds), mean_text(task, returns), means)
