"""Returns of the hand-written policies, to compare curves with."""

import csv
from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path

from jbrep.envs.lanes import Lanes
from jbrep.envs.recording import episode_returns
from jbrep.envs.task import Array, Task
from jbrep.files.tables import write_csv
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.rl.files import EVALUATION_SEED

HEURISTIC_RETURNS = "heuristics.csv"
_EPISODES = 20  # with the starts of every run's evaluations
_COLUMNS = ("task", "episode", "return")


def write_heuristics(tasks: Iterable[Task], folder: Path) -> Path | None:
    """Play the hand-written policies of the tasks, unless the file has exactly these tasks.

    Returns:
        The file; None if no task has such a policy, and then there is no file.
    """
    path = folder / HEURISTIC_RETURNS
    wanted = {task.name: task for task in tasks if task.name in HEURISTICS}
    if not wanted:
        path.unlink(missing_ok=True)
        return None
    there: list[str] = []
    with suppress(OSError, ValueError):
        there = [row[0] for row in csv.reader(path.read_text().splitlines()[1:])]
    if there != [name for name in sorted(wanted) for _ in range(_EPISODES)]:
        rows = (
            (name, episode, f"{each:.3f}")
            for name in sorted(wanted)
            for episode, each in enumerate(_returns(wanted[name]))
        )
        write_csv(path, _COLUMNS, rows)
    return path


def _returns(task: Task) -> Array:
    with closing(Lanes(task, _EPISODES)) as lanes:
        return episode_returns(lanes, HEURISTICS[task.name], EVALUATION_SEED)
