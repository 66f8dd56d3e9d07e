"""A policy that does a task well, for the diagnostics of encoders."""

from typing import Any

from numpy.typing import NDArray

from jbrep.collect.policies import POLICIES
from jbrep.envs.lanes import Lanes
from jbrep.envs.recording import record
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.evaluate.control import GoodPolicy, PlayedEpisode
from jbrep.play.jitterbug import jitterbug_task
from jbrep.play.sources import Player, find_player
from jbrep.progress import Progress
from jbrep.rl.files import EVALUATION_SEED

_EPISODES = 30
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

    return GoodPolicy(source, act, _played(player))


def _played(player: Player) -> list[PlayedEpisode]:
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + _EPISODES)
    lanes = Lanes(player.task, _EPISODES)
    lanes.reset(range(_EPISODES), seeds)
    total = _EPISODES * player.task.max_episode_steps
    with Progress(total=total, unit="step", unit_scale=True, leave=False, delay=1) as progress:
        recording = record(lanes, player.begin(player.task, seeds), progress.update)
    lanes.close()
    return [
        PlayedEpisode(
            recording.observation[: length + 1, lane],
            recording.reward[:length, lane],
            bool(recording.terminated[lane]),
        )
        for lane, length in enumerate(recording.length.tolist())
    ]
