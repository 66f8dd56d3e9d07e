"""What policies do, as tables: how the motor turns, and where the robot goes."""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.envs.task import Array, Task
from jbrep.errors import InputError, Notice
from jbrep.play.jitterbug import jitterbug_task
from jbrep.play.player import Player
from jbrep.play.sources import find_player, find_untrained, is_by_name, run_folder
from jbrep.rl.files import FINISHED, read_run, runs_below
from jbrep.text import counted

SPEEDS = np.linspace(-180, 180, 73)  # edges of the bins of the motor's velocity [rad/s]
FAST = 30.0  # of the motor, either way [rad/s]
_CELL = 0.02  # edge of a cell of the floor [m]


@dataclass(frozen=True, eq=False)
class Behaviour:
    """The behaviour of a policy over some episodes.

    Args:
        name: of the policy.
        returns: of each episode, (episodes,).
        motor: share of time in each bin of the motor velocity, (b,).
        edges: edges of the floor's cells, the same in x and y [m], (k + 1,).
        places: share of time in each cell, x first, (k, k).
        mean_place: the mean of where the robot is, x and y (2,) [m].
    """

    name: str
    returns: Array
    motor: Array
    edges: Array
    places: Array
    mean_place: Array


def observe(
    sources: Sequence[str], task: Task | None, episodes: int, target_yaw: float
) -> tuple[Task, list[Behaviour]]:
    """What policies do in the same episodes; for runs, also the policies that they began with.

    The tables are of the Jitterbug's motor, and of its place on the floor.

    Args:
        sources: as `find_player` takes them, or folders with several runs, which count as one.
        task: for policies by their names.
        episodes: how many, of each run.
        target_yaw: where every target points [rad].
    """
    subjects: dict[str, list[Player]] = {}
    shared = task
    for source, short in zip(sources, _short(sources), strict=True):
        runs, players = _runs(source), []
        for each in runs or (source,):
            player = find_player(str(each), shared if is_by_name(str(each)) else task)
            shared = _shared(player, shared)
            players.append(player)
        if runs:
            assert shared is not None  # the players'
            subjects[f"{short}, before training"] = [find_untrained(run, shared) for run in runs]
        subjects[_title(short, players)] = players
    played = {name: _visits(each, episodes, target_yaw) for name, each in subjects.items()}
    reach = max(np.abs(visits.position).max() for visits in played.values())
    cells = int(np.ceil((reach + _CELL) / _CELL))
    edges: Array = _CELL * np.arange(-cells, cells + 1, dtype=np.float64)
    assert shared is not None  # the players'
    return shared, [_counted(name, visits, edges) for name, visits in played.items()]


def fast_shares(behaviour: Behaviour) -> tuple[float, float]:
    """Shares of time in which the motor turns at FAST or more, one way and the other."""
    low, high = SPEEDS[:-1], SPEEDS[1:]
    return behaviour.motor[high <= -FAST].sum(), behaviour.motor[low >= FAST].sum()


def _short(sources: Sequence[str]) -> list[str]:
    """What tells sources apart: of paths, what follows the folder that all of them are in."""
    places = {each: (run_folder(each) or Path(each)).absolute() for each in sources}
    folders = [place.parent for each, place in places.items() if not is_by_name(each)]
    shared = os.path.commonpath(folders) if folders else ""
    return [each if is_by_name(each) else os.path.relpath(places[each], shared) for each in sources]


def _title(short: str, players: Sequence[Player]) -> str:
    if len(players) > 1:
        return f"{short}, {len(players)} runs"
    step = players[0].step
    return short if step is None else f"{short} at step {step:,}"


def _runs(source: str) -> list[Path]:
    """The run that a source names, or the finished ones below a folder; none of a name."""
    if folder := run_folder(source):
        return [folder]
    if is_by_name(source):
        return []
    ended = runs_below(Path(source))
    finished = [run for run in ended if read_run(run).status == FINISHED]
    if left := len(ended) - len(finished):
        told = f"{counted(left, 'run')} below {source} failed, and has no policy: left out"
        warnings.warn(told, Notice, stacklevel=2)
    return finished


def _shared(player: Player, shared: Task | None) -> Task:
    """The task of a player, which must be the Jitterbug's, and that of the others if there are."""
    if shared and player.task.id != shared.id:
        raise InputError(f"{player.name} is of {player.task.name}, not of {shared.name}")
    if shared and player.task != shared:
        raise InputError(
            f"{player.name} learned with another body or time limit than the policies before it: "
            f"add --task {shared.name}, with --env or --episode-steps, to play all in the same"
        )
    if jitterbug_task(player.task) is None:
        raise InputError(
            f"{player.name} is of {player.task.name}: only the Jitterbug's tasks have the motor "
            "and the free body whose behaviour is drawn"
        )
    return player.task


class _Visits(NamedTuple):
    """Where policies that count as one went, and how the motor turned."""

    returns: Array  # of each episode, (episodes,)
    motor: Array  # its velocity in each state, (n,) [rad/s]
    position: Array  # x and y in each state, (n, 2) [m]


def _visits(players: Sequence[Player], episodes: int, target_yaw: float) -> _Visits:
    returns, motor, position = [], [], []
    for rollout in chain.from_iterable(p.play_first(episodes, target_yaw) for p in players):
        assert rollout.motion is not None  # the Jitterbug has one
        returns.append(rollout.episode_return)
        motor.append(rollout.motion.qvel[:, -1].copy())  # a view would keep the whole rollout
        position.append(rollout.motion.qpos[:, :2].copy())
    return _Visits(np.array(returns), np.concatenate(motor), np.concatenate(position))


def _counted(name: str, visits: _Visits, edges: Array) -> Behaviour:
    """The shares of states by motor velocity, and by cells between these edges [m]."""
    motor, _ = np.histogram(visits.motor.clip(SPEEDS[0], SPEEDS[-1]), SPEEDS)
    x, y = visits.position.T
    places, _, _ = np.histogram2d(x, y, (edges, edges))
    mean = visits.position.mean(axis=0)
    return Behaviour(name, visits.returns, motor / motor.sum(), edges, places / places.sum(), mean)
