"""A single run beside policies that don't learn."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jbrep.envs.task import Array, Task
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.stats.labels import NO, UNCLEAR, YES, learnt
from jbrep.stats.scale import LOOKING, best_blind
from jbrep.study.tables import references_of
from jbrep.text import counted, rounded

_WORDS = {YES: "learned", UNCLEAR: "not clearly learned", NO: "not learned"}


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
    played = references_of(task, episodes)
    means = {policy: float(each.mean()) for policy, each in played.items()}
    best = best_blind(means)
    if best is None:
        return None
    bounds = Bounds.of(task.return_floor, task.return_ceiling)
    blind = mean_within(played[best], bounds, LEVEL)
    own = np.asarray(returns[:episodes])
    return Beside(learnt(own, blind, bounds), float(own.mean()), means, episodes)
