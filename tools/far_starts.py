"""How far from the target robots begin whose episodes return nothing.

python tools/far_starts.py results/figure-7-sac takes the last evaluation of every run of a study
on move_to_position and move_to_pose, and prints a table.
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from jbrep.jitterbug.tasks import TASKS
from jbrep.rl.files import EVALUATION_SEED

NOTHING = 5  # a return below this
EDGES = np.arange(4, 21, 2) / 100  # [m]


def main(folder: Path) -> None:
    """Print a row for each range of distances."""
    returns = pd.read_csv(folder / "returns.csv")
    last = returns[returns["step"] == returns.groupby("task")["step"].transform("max")]
    last = last[last["task"].isin(["move_to_position", "move_to_pose"])]
    away = [
        distance(task, episode) for task, episode in zip(last["task"], last["episode"], strict=True)
    ]
    ranges = pd.cut(away, EDGES).rename_categories(lambda r: f"{r.left:.2f} to {r.right:.2f} m")
    failed = last["return"] < NOTHING
    table = failed.groupby([last["task"], ranges], observed=True).agg(["sum", "count"])
    table.columns = ["return nothing", "episodes"]
    print(table.unstack(0).swaplevel(axis=1).sort_index(axis=1).to_string())


def distance(task: str, episode: int) -> float:
    """From the target where an episode of every evaluation begins [m]."""
    start = TASKS[task].start(np.random.default_rng(EVALUATION_SEED + episode))
    return float(np.hypot(*start.target_position[:2]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
