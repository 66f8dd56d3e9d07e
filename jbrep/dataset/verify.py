"""Verifying a data set: hashes, shapes, numbers and ranges."""

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.manifest import (
    BACKUP,
    Manifest,
    current_manifest,
    file_problems,
    hdf5_files,
    open_shard,
    read_manifest,
    shard_name,
)
from jbrep.dataset.schema import EPISODES, UNKNOWN_SEED, Columns
from jbrep.dataset.settings import TRAINED, parts_of
from jbrep.dataset.shard import REPAIR, column_hash
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError
from jbrep.progress import Progress
from jbrep.records.storage import read_file

_MAX_POLICY_BYTES = 1 << 28


def find_problems(folder: Path) -> Iterator[str]:
    """Check the files of a data set.

    Yields:
        A line for each problem.
    """
    files = hdf5_files(folder)
    try:
        manifest = current_manifest(folder)
    except DamageError as damage:
        yield str(damage)
        return
    yield from file_problems(folder, manifest, files)
    yield from _backup_problems(folder, manifest)
    yield from _policy_problems(folder, manifest)
    for shard in Progress(range(len(manifest.shards)), unit="shard", desc="verify", leave=False):
        path = folder / shard_name(shard)
        try:
            columns = dict(open_shard(folder, manifest, shard))
        except DamageError as damage:
            if path.exists() and path.lstat().st_size == manifest.shards[shard].bytes:
                yield str(damage)  # a wrong size or absence has been reported above
            continue
        for problem in _content_problems(manifest, shard, columns):
            yield f"{path}: {problem}"


def _backup_problems(folder: Path, manifest: Manifest) -> Iterator[str]:
    """The backup equals the manifest, or is the one that the collector writes next."""
    try:
        backup = read_manifest(folder, BACKUP)
    except InputError as error:
        yield str(error)
        return
    if not manifest.is_next(backup):
        yield f"{folder / BACKUP} is of another data set: {REPAIR}"


def _policy_problems(folder: Path, manifest: Manifest) -> Iterator[str]:
    try:
        policy_files(folder, manifest)
    except DamageError as damage:
        yield str(damage)


def policy_files(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    """The files of the trained policies that acted in a data set, by name.

    Raises:
        DamageError: one isn't there, or not as it was when it acted.
    """
    files = dict[str, bytes]()
    for policy in (each for each in parts_of(manifest.settings.policy) if each["kind"] == TRAINED):
        path, raw = folder / policy["file"], b""
        with suppress(InputError):
            raw = read_file(path)
        if hashlib.sha256(raw).hexdigest() != policy["sha256"]:
            raise DamageError(
                f"{path} is damaged or missing: it is the policy of {policy['run']} at step "
                f"{policy['step']:,}, which only a copy can restore"
            )
        files[policy["file"]] = raw
    return files


def _content_problems(manifest: Manifest, shard: int, columns: Columns) -> Iterator[str]:
    """Numbers that aren't those committed, not finite, out of range, or inconsistent."""
    for name, expected in manifest.shards[shard].sha256.items():
        if column_hash(columns[name]) != expected:
            yield f"the SHA-256 of {name} differs from the manifest's"
    for name, values in columns.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            yield f"{name} has values that are not finite"
    yield from range_problems(manifest.task, columns)
    yield from _episode_problems(manifest, shard, columns)


def range_problems(task: Task, columns: Columns) -> Iterator[str]:
    """A line for each action, reward or feature beyond the task's bounds."""
    names = [f"action {i}" for i in range(task.action_size)]
    bounds = zip(names, columns["action"].T, task.action_low, task.action_high, strict=True)
    ranges: list[tuple[str, NDArray[Any], float, float]] = list(bounds)
    reward_low = -np.inf if task.reward_low is None else min(task.reward_low, 0)
    reward_high = np.inf if task.reward_high is None else max(task.reward_high, 0)
    if "reward" in columns:
        ranges.append(("reward", columns["reward"], reward_low, reward_high))
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


def _episode_problems(manifest: Manifest, shard: int, columns: Columns) -> Iterator[str]:
    """Columns that are inconsistent with the settings or with each other."""
    settings, stored = manifest.settings, columns[EPISODES + "seed"]
    numbers = shard * settings.shard_episodes + np.arange(len(stored))
    # imported episodes may have any seed, or an unknown one
    seeds = np.maximum(stored, UNKNOWN_SEED) if settings.is_imported else settings.seeds(numbers)
    own = {EPISODES + "episode": numbers, EPISODES + "seed": seeds}
    expected = settings.columns({**columns, **own})
    wrong = [
        name
        for name, values in columns.items()
        if expected[name] is not values and not np.array_equal(expected[name], values)
    ]
    if not ((columns[EPISODES + "terminated"] | columns[EPISODES + "truncated"]) == 1).all():
        wrong.append("the ends of episodes")
    for what in wrong:
        yield f"{what}: inconsistent with the settings, or with other columns"
