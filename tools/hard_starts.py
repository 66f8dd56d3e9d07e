"""Where robots begin whose episodes fail: python tools/hard_starts.py FOLDER.

Takes the last evaluation of every run of a study, or what tools/starts.py wrote beside it, and
prints for ranges of starts how many episodes fail of how many, by representation: on
move_to_position and move_to_pose by the distance of the target, where it is a direction by the
angle to it, on move_from_origin by the robot's tilt. Then at how many starts any run fails, and at
most how many do at one: failures that are no matter of the start are spread over most. At the end
what episodes return, in the median and in the best tenth.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jbrep.envs.task import Array
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import TASKS, Readings
from jbrep.rl.files import EVALUATION_SEED

RUN = ["task", "algorithm", "representation", "seed"]  # columns that tell it


class Measured(NamedTuple):
    """What tells a hard start of a task."""

    name: str
    of: Callable[[Readings], Array]
    edges: tuple[float, ...]  # of the ranges
    failed: float  # an episode with a lower return


def distance(readings: Readings) -> Array:
    return np.hypot(*(readings.target_position - readings.qpos[:, :3])[:, :2].T)


def angle(readings: Readings) -> Array:
    return np.abs(readings.angle_to_target)


def tilt(readings: Readings) -> Array:
    return np.arccos(readings.uprightness)


BY_DISTANCE = Measured("m to the target", distance, (0.04, 0.08, 0.12, 0.16, 0.2), 5)
BY_ANGLE = Measured("rad to the target", angle, (0, 1, 2, 2.5, 2.8, np.pi), 400)
BY_TASK = {
    "move_from_origin": Measured("rad from upright", tilt, (0, 0.02, 0.04, 0.06, 0.08), 500),
    "move_to_position": BY_DISTANCE,
    "move_to_pose": BY_DISTANCE,
    "face_direction": BY_ANGLE,
    "move_in_direction": BY_ANGLE._replace(failed=300),
}


def last_episodes(folder: Path) -> pd.DataFrame:
    """Columns task, representation, episode and return, of trained policies."""
    returns = pd.read_csv(folder / "returns.csv")
    if (folder / "starts.csv").exists():
        (task,) = returns["task"].unique()
        starts = pd.read_csv(folder / "starts.csv").dropna(subset="seed")
        return starts.rename(columns={"value": "return"}).assign(task=task)
    return returns[returns["step"] == returns.groupby(RUN)["step"].transform("max")]


def measured(task: str, episodes: int) -> Array:
    """What tells hard starts, of the first episodes that runs are evaluated in, (episodes,)."""
    robots = Simulation(TASKS[task], episodes)
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + episodes)
    robots.reset(range(episodes), [np.random.default_rng(seed) for seed in seeds])
    return BY_TASK[task].of(robots.readings)


def main(folder: Path) -> None:
    """Print a table for each task."""
    for task, episodes in last_episodes(folder).groupby("task"):
        print(f"{table(task, episodes)}\n")


def table(task: str, episodes: pd.DataFrame) -> str:
    """Ranges of starts by representations: how many episodes fail of how many; then how spread."""
    name, _, edges, failed = BY_TASK[task]
    number, representation = episodes["episode"], episodes["representation"]
    ranges = pd.cut(measured(task, number.max() + 1)[number], edges)
    fails = episodes["return"] < failed
    counts = _counted(fails.groupby([ranges, representation], observed=True)).unstack()
    counts.index = [f"{each.left:g} to {each.right:g} {name}" for each in counts.index]
    counts.loc["all"] = _counted(fails.groupby(representation))
    at = fails.groupby([representation, number]).sum().groupby("representation")
    counts.loc["starts where any does"] = _counted(at.apply(lambda each: each > 0).groupby(level=0))
    counts.loc["at one start, at most"] = at.max()
    returns = episodes.groupby("representation")["return"]
    counts.loc["median return"] = returns.median().map("{:.0f}".format)
    counts.loc["a tenth returns more than"] = returns.quantile(0.9).map("{:.0f}".format)
    return f"{task}: episodes that return less than {failed:g}\n{counts.to_string()}"


def _counted(groups: Any) -> Any:
    """How many of how many, of each group."""
    return groups.agg(lambda each: f"{each.sum()} of {len(each)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
