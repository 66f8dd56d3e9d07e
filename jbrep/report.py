"""Runs side by side."""

import json
from pathlib import Path

import numpy as np

from jbrep.errors import InputError

_ROW = "{:<20} {:<10} {:<8} {:>4} {:>9} {:>15} {:>20}"


def summarise(folder: Path) -> str:
    """A table of the runs below the folder: median return and 10th to 90th percentile.

    Raises:
        InputError: no finished run there.
    """
    files = sorted(folder.rglob("run.json"))
    if not files:
        raise InputError(f"no finished run below {folder}: a run.json is expected")
    lines = [_ROW.format("task", "algorithm", "state", "seed", "steps", "median return", "10-90 %")]
    for file in files:
        result = json.loads(file.read_text())
        run = result["run"]
        low, median, high = np.percentile(result["returns"], (10, 50, 90))
        state = result["representation"]
        spread = f"[{low:.0f}, {high:.0f}]"
        settings = (run["task"], run["algorithm"], state, run["seed"], f"{run['steps']:,}")
        lines.append(_ROW.format(*settings, f"{median:.0f}", spread))
    return "\n".join(lines)
