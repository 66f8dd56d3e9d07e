"""Whether the files of a data set are those that were written, and numbers within their bounds."""

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.manifest import Manifest, open_shard, read_manifest, shard_path
from jbrep.dataset.schema import EPISODES, Columns
from jbrep.dataset.settings import TRAINED, parts_of
from jbrep.envs.task import Task
from jbrep.errors import DamageError
from jbrep.progress import Progress


def find_problems(folder: Path) -> Iterator[str]:
    """A line for each file of a data set that is damaged or missing, or has what can't be."""
    try:
        manifest = read_manifest(folder)
    except DamageError as damage:
        yield str(damage)
        return
    try:
        policy_files(folder, manifest)
    except DamageError as damage:
        yield str(damage)
    for shard in Progress(range(len(manifest.shards)), unit="shard", desc="verify", leave=False):
        try:
            columns = open_shard(folder, manifest, shard)
        except DamageError as damage:
            yield str(damage)
        else:
            for problem in range_problems(manifest.task, columns):
                yield f"{shard_path(folder, shard)}: {problem}"


def policy_files(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    """The files of the trained policies that acted in a data set, by name.

    Raises:
        DamageError: one isn't there, or not as it was when it acted.
    """
    files = dict[str, bytes]()
    for policy in (each for each in parts_of(manifest.settings.policy) if each["kind"] == TRAINED):
        path, raw = folder / Path(policy["file"]).name, b""
        with suppress(OSError):
            raw = path.read_bytes()
        if hashlib.sha256(raw).hexdigest() != policy["sha256"]:
            raise DamageError(
                f"{path} is damaged or missing: it is the policy of {policy['run']} at step "
                f"{policy['step']:,}, which only a copy can restore"
            )
        files[path.name] = raw
    return files


def range_problems(task: Task, columns: Columns) -> Iterator[str]:
    """A line for each action, reward or feature beyond the task's bounds."""
    names = [f"action {i}" for i in range(task.action_size)]
    bounds = zip(names, columns["action"].T, task.action_low, task.action_high, strict=True)
    ranges: list[tuple[str, NDArray[np.float32], float, float]] = list(bounds)
    if "reward" in columns:
        low = -np.inf if task.reward_low is None else min(task.reward_low, 0)
        high = np.inf if task.reward_high is None else max(task.reward_high, 0)
        ranges.append(("reward", columns["reward"], low, high))
    for values in (columns["observation"], columns[EPISODES + "final_observation"]):
        ranges += [
            (feature.name, values[:, i], feature.low, feature.high)
            for i, feature in enumerate(task.features)
            if feature.bounded and feature.low is not None and feature.high is not None
        ]
    for name, values, low, high in ranges:
        if len(values) and not np.float32(low) <= values.min() <= values.max() <= np.float32(high):
            extent = f"ranges from {values.min():g} to {values.max():g}"
            yield f"{name} {extent}, beyond [{low:g}, {high:g}]"
