"""Format version 1, of the first release: the Jitterbug's data sets, named by their task alone.

Episodes had 1,000 steps at most; one whose physics diverged lacks its last row, and is flagged by
the column `diverged` instead of `terminated` and `truncated`.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.schema import EPISODES, Columns
from jbrep.jitterbug.tasks import EPISODE_STEPS, get_task
from jbrep.records.record import to_plain

if TYPE_CHECKING:
    from jbrep.dataset.settings import Settings

_END = EPISODES + "diverged"


def episodes(settings: "Settings") -> int:
    """Number of episodes of a complete data set."""
    return -(-settings.steps // EPISODE_STEPS)


def mapped(record: dict[str, Any]) -> dict[str, Any]:
    """A manifest of version 1 with what the current version has besides."""
    settings = dict(record["settings"])
    settings["environment"] = to_plain(get_task(settings["task"]).describe())
    full, total = settings["shard_episodes"], -(-settings["steps"] // EPISODE_STEPS)
    shards = [
        {**entry, "episodes": min(full, total - full * shard)}
        for shard, entry in enumerate(record["shards"])
    ]
    return {**record, "settings": settings, "shards": shards}


def record(current: dict[str, Any]) -> dict[str, Any]:
    """The inverse of `mapped`."""
    settings = {n: v for n, v in current["settings"].items() if n != "environment"}
    shards = [{n: v for n, v in entry.items() if n != "episodes"} for entry in current["shards"]]
    return {**current, "settings": settings, "shards": shards}


def columns(current: Columns) -> dict[str, NDArray[Any]]:
    """The columns of a shard as version 1 has them."""
    length = current[EPISODES + "length"]
    diverged = (current[EPISODES + "truncated"] == 1) & (length < EPISODE_STEPS)
    lasts = np.cumsum(length)[diverged] - 1
    kept = np.delete(np.arange(length.sum()), lasts)
    changed = {
        EPISODES + "length": length - diverged.astype(length.dtype),
        _END: diverged.astype("u1"),
    }
    result: dict[str, NDArray[Any]] = {}
    for name, values in current.items():
        if name == EPISODES + "terminated":
            result[_END] = changed[_END]
        elif name != EPISODES + "truncated":
            result[name] = changed.get(name, values if name.startswith(EPISODES) else values[kept])
    for name in [n for n in current if n.startswith(EPISODES + "final_")]:
        source = current[name.removeprefix(EPISODES + "final_")]
        result[name] = result[name].copy()
        result[name][diverged] = source[lasts]
    return result


def with_ends(columns: Columns) -> Columns:
    """Columns of any version with `terminated` and `truncated` in place of `diverged`."""
    ends: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        if name.rpartition("/")[2] == "diverged":
            group = name.removesuffix("diverged")
            ends[f"{group}terminated"] = np.zeros_like(values)
            ends[f"{group}truncated"] = np.ones_like(values)
        else:
            ends[name] = values
    return ends
