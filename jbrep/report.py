"""Runs side by side."""

import json
from pathlib import Path

import numpy as np

from jbrep.errors import InputError
from jbrep.tables import table

_HEADER = ("task", "algorithm", "state", "seed", "steps", "median return", "10-90 %")


def summarise(folder: Path) -> str:
    """A table of the runs below the folder: median return and 10th to 90th percentile.

    Raises:
        InputError: no finished run there.
    """
    files = sorted(folder.rglob("run.json"))
    if not files:
        raise InputError(f"no finished run below {folder}: a run.json is expected")
    rows = []
    for file in files:
        result = json.loads(file.read_text())
        run = result["run"]
        low, median, high = np.percentile(result["returns"], (10, 50, 90))
        settings = run["task"], run["algorithm"], result["representation"], str(run["seed"])
        rows.append((*settings, f"{run['steps']:,}", f"{median:.0f}", f"[{low:.0f}, {high:.0f}]"))
    return table(_HEADER, rows)
