"""Returns of the hand-written policies, to compare curves with."""

import csv
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from jbrep.files.tables import write_csv
from jbrep.jitterbug.heuristics import HEURISTICS, episode_returns
from jbrep.rl.files import EVALUATION_SEED

HEURISTIC_RETURNS = "heuristics.csv"
_EPISODES = 20  # with the starts of every run's evaluations
_COLUMNS = ("task", "episode", "return")


def write_heuristics(tasks: Iterable[str], folder: Path) -> Path:
    """Play the hand-written policy of each task, unless the file has exactly these tasks."""
    path = folder / HEURISTIC_RETURNS
    wanted = sorted(set(tasks))
    there: list[str] = []
    with suppress(OSError, ValueError):
        there = [row[0] for row in csv.reader(path.read_text().splitlines()[1:])]
    if there != [task for task in wanted for _ in range(_EPISODES)]:
        returns = {
            task: episode_returns(task, HEURISTICS[task], _EPISODES, EVALUATION_SEED)
            for task in wanted
        }
        rows = (
            (task, episode, f"{each:.3f}")
            for task, played in returns.items()
            for episode, each in enumerate(played)
        )
        write_csv(path, _COLUMNS, rows)
    return path
