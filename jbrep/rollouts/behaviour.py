"""What policies do, as tables: how the motor turns, and where the robot goes."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jbrep.figures.behaviour import Behaviour
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import Array, Task
from jbrep.rl.files import RUN
from jbrep.rollouts.sources import Player, find_player

SPEEDS = np.linspace(-180, 180, 73)  # edges of bins of the motor's velocity [rad/s]
_CELL = 0.02  # edge of a cell of the floor [m]


def observe(
    sources: Sequence[str], task: str | None, episodes: int, target_yaw: float
) -> tuple[Task, list[Behaviour]]:
    """What policies do in the same episodes; of a run, also the policy that it began with.

    Args:
        sources: as `find_player` takes them.
        task: for policies by their names.
        episodes: how many.
        target_yaw: where every target points [rad].

    Raises:
        InputError: as `find_player`, or policies of several tasks.
    """
    players: list[Player] = []
    for source in sources:
        player = find_player(source, task)
        task = player.task.name
        players += [*_before(source, player), player]
    played = [_Visits(player, episodes, target_yaw) for player in players]
    reach = max(np.abs(visits.position).max() for visits in played)
    cells = int(np.ceil((reach + _CELL) / _CELL))
    edges: Array = _CELL * np.arange(-cells, cells + 1, dtype=np.float64)
    return players[0].task, [visits.counted(edges) for visits in played]


def _before(source: str, player: Player) -> Iterable[Player]:
    """The policy that a run began with; nothing for a policy that didn't learn."""
    if exists(Path(source) / RUN):
        from jbrep.rl.policy import load_untrained  # brings torch

        began = load_untrained(Path(source)).begin
        yield player._replace(name=f"{player.name}, before training", begin=began)


class _Visits:
    """Where a policy went, and how the motor turned."""

    def __init__(self, player: Player, episodes: int, target_yaw: float):
        rollouts = player.play(range(episodes), target_yaw)
        self._name = player.name
        self._returns = np.array([rollout.reward.sum() for rollout in rollouts])
        self._motor = np.concatenate([rollout.qvel[:, -1] for rollout in rollouts])
        self.position = np.concatenate([rollout.qpos[:, :2] for rollout in rollouts])

    def counted(self, edges: Array) -> Behaviour:
        x, y = self.position.T
        return Behaviour(
            name=self._name,
            returns=self._returns,
            motor=_shares(np.histogram(self._motor.clip(SPEEDS[0], SPEEDS[-1]), SPEEDS)[0]),
            edges=edges,
            places=_shares(np.histogram2d(x, y, (edges, edges))[0]),
        )


def _shares(counts: NDArray[np.number]) -> Array:
    return counts / counts.sum()
