"""Policies that agents are compared with: some that don't look, and the hand-written ones."""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from jbrep.envs.task import Array, Task
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.play.sources import find_player
from jbrep.records.tables import rounded as as_in_tables
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.stats.labels import NO, UNCLEAR, YES, learnt
from jbrep.stats.scale import CONSTANT, LOOKING, RANDOM, STILL, best_blind
from jbrep.text import counted, rounded

_POLICIES = {
    STILL: "still",
    CONSTANT: "constant:drive=0.75",  # of five, what moves the Jitterbug furthest
    RANDOM: "uniform",
    LOOKING: "heuristic",
}
_WORDS = {YES: "learned", UNCLEAR: "not clearly learned", NO: "not learned"}


def policies_of(task: Task) -> list[str]:
    """The names of the reference policies that a task has."""
    return [policy for policy in _POLICIES if policy != LOOKING or task.name in HEURISTICS]


def play(policy: str, task: Task, episodes: int) -> list[float]:
    """Returns of a policy, of these or by name, in a task's first episodes, as tables have them."""
    one_by_one = None if task.reproducible else 1  # a robot may exist once
    returns = find_player(_POLICIES.get(policy, policy), task).returns(episodes, one_by_one)
    return [*map(as_in_tables, returns)]


class Beside(NamedTuple):
    """What a run's agent returns, beside policies that don't learn, in the same episodes.

    Attributes:
        learnt: yes, no or unclear: whether it ends above the best policy that doesn't look.
        mean: return of the agent.
        references: mean returns by policy.
        episodes: how many these are.
    """

    learnt: str
    mean: float
    references: dict[str, float]
    episodes: int

    def __str__(self) -> str:
        agent, *others = rounded(self.mean, *self.references.values())
        shown = dict(zip(self.references, others, strict=True))
        written = shown.pop(LOOKING, None)
        told = ", ".join(f"{name} {value}" for name, value in shown.items())
        told += f"; {LOOKING} {written}" if written else ""
        played = counted(self.episodes, "episode")
        return (
            f"{_WORDS[self.learnt]}: on average {agent} in {played} (in the same, policies that "
            f"don't look: {told})"
        )


def beside(task: Task, returns: Sequence[float] | Array, episodes: int) -> Beside | None:
    """Compare a run's final returns with those of policies that don't learn, in some episodes.

    Args:
        task: of the run.
        returns: of the final evaluation's episodes.
        episodes: how many of these, the first, count; the other policies play from their starts.

    Returns:
        None where the other policies can't be played.
    """
    played = dict[str, Array]()
    for policy in policies_of(task):
        with suppress(Exception):  # of an environment that isn't installed there are none
            played[policy] = np.array(play(policy, task, episodes))
    means = {policy: float(each.mean()) for policy, each in played.items()}
    best = best_blind(means)
    if best is None:
        return None
    bounds = Bounds.of(task.return_floor, task.return_ceiling)
    blind = mean_within(played[best], bounds, LEVEL)
    own = np.asarray(returns[:episodes])
    return Beside(learnt(own, blind, bounds), float(own.mean()), means, episodes)
