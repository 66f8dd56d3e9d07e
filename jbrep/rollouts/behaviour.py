"""What policies do, as tables: how the motor turns, and where the robot goes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Array, Task
from jbrep.errors import InputError
from jbrep.figures.behaviour import Behaviour
from jbrep.rollouts.jitterbug import jitterbug_task
from jbrep.rollouts.sources import Player, find_player, find_untrained, run_folder

SPEEDS = np.linspace(-180, 180, 73)  # edges of the bins of the motor's velocity [rad/s]
_CELL = 0.02  # edge of a cell of the floor [m]


def observe(
    sources: Sequence[str], task: Task | None, episodes: int, target_yaw: float
) -> tuple[Task, list[Behaviour]]:
    """What policies do in the same episodes; for a run, also the policy that it began with.

    The tables are of the Jitterbug's motor, and of its place on the floor.

    Args:
        sources: as `find_player` takes them.
        task: for policies by their names.
        episodes: how many.
        target_yaw: where every target points [rad].

    Raises:
        InputError: as `find_player`, or policies of several tasks, or of another robot's.
    """
    players: list[Player] = []
    for source in sources:
        player = find_player(source, task)
        task = player.task
        if jitterbug_task(task) is None:
            raise InputError(
                f"{source} is of {task.name}: only the Jitterbug's tasks have the motor and the "
                "free body whose behaviour is drawn"
            )
        if folder := run_folder(source):
            players.append(find_untrained(folder))
        players.append(player)
    played = [_Visits(player, episodes, target_yaw) for player in players]
    reach = max(np.abs(visits.position).max() for visits in played)
    cells = int(np.ceil((reach + _CELL) / _CELL))
    edges: Array = _CELL * np.arange(-cells, cells + 1, dtype=np.float64)
    return players[0].task, [visits.counted(edges) for visits in played]


class _Visits:
    """Where a policy went, and how the motor turned."""

    def __init__(self, player: Player, episodes: int, target_yaw: float):
        self._name = player.name
        returns, motor, position = [], [], []
        for rollout in player.play_first(episodes, target_yaw):
            assert rollout.motion is not None  # the Jitterbug has one
            returns.append(rollout.episode_return)
            motor.append(rollout.motion.qvel[:, -1].copy())  # a view would keep the whole rollout
            position.append(rollout.motion.qpos[:, :2].copy())
        self._returns, self._motor = np.array(returns), np.concatenate(motor)
        self.position = np.concatenate(position)

    def counted(self, edges: Array) -> Behaviour:
        """The shares of states by motor velocity, and by cells between these edges [m]."""
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
