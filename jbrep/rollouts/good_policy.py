"""A policy that does a task well, for the diagnostics of encoders."""

from typing import Any

from numpy.typing import NDArray

from jbrep.collect.policies import POLICIES
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.evaluate.policy import GoodPolicy, PlayedEpisode
from jbrep.rollouts.jitterbug import jitterbug_task
from jbrep.rollouts.sources import find_player

_EPISODES = 40
HEURISTIC = "heuristic"


def find_good_policy(source: str | None, task: Task) -> GoodPolicy | None:
    """A policy with the episodes that it plays: the first of those that runs are evaluated on.

    Args:
        source: as `find_player` takes it; None for the hand-written policy, if the task has one.
        task: to act in.

    Raises:
        InputError: as `find_player`, or the policy doesn't act on what it observes.
    """
    if source is None:
        if jitterbug_task(task) is None:
            return None
        source = HEURISTIC
    known = POLICIES.get(source.partition(":")[0])
    if known is not None and known.open_loop:
        raise InputError(
            f"policy {source} doesn't act on what it observes: give {HEURISTIC} or a run's folder"
        )
    player = find_player(source, task)

    def act(observation: NDArray[Any]) -> NDArray[Any]:
        return player.begin(task, range(len(observation)))(observation)

    played = (
        PlayedEpisode(rollout.observation, rollout.reward, rollout.terminated)
        for rollout in player.play_first(_EPISODES)
    )
    return GoodPolicy(source, act, list(played))
