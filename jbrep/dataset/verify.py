"""Is a data set what it says it is? Hashes, shapes, numbers and ranges."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jbrep.dataset.manifest import (
    BACKUP,
    Manifest,
    file_problems,
    hdf5_files,
    open_shard,
    read_manifest,
    shard_name,
)
from jbrep.dataset.schema import EPISODES, Columns, episode_columns, episode_returns, episode_seed
from jbrep.dataset.shard import MEND, column_hash
from jbrep.errors import DamageError, InputError
from jbrep.jitterbug.tasks import EPISODE_STEPS, Task
from jbrep.progress import Progress

_BOUNDED = ("rad", "1")  # angles are wrapped, quaternions are of length 1: their ranges are bounds


def find_problems(folder: Path) -> Iterator[str]:
    """Everything about the files of a data set that isn't as it should be, a line for each.

    Raises:
        InputError: there is no data set.
    """
    files = hdf5_files(folder)
    try:
        manifest = read_manifest(folder)
    except DamageError as damage:
        yield str(damage)
        return
    yield from file_problems(folder, manifest, files)
    yield from _backup_problems(folder, manifest)
    for shard in Progress(range(len(manifest.shards)), unit="shard", desc="verify", leave=False):
        path = folder / shard_name(shard)
        try:
            columns = dict(open_shard(folder, manifest, shard))
        except DamageError as damage:
            if path.exists() and path.lstat().st_size == manifest.shards[shard].bytes:
                yield str(damage)  # else its size or absence has been told
            continue
        for problem in _hash_problems(manifest, shard, columns):
            yield f"{path}: {problem}"
        for problem in _content_problems(manifest, shard, columns):
            yield f"{path}: {problem}"


def _backup_problems(folder: Path, manifest: Manifest) -> Iterator[str]:
    """The backup may be a shard ahead of the manifest of an unfinished data set, no more."""
    try:
        backup = read_manifest(folder, BACKUP)
    except InputError as error:
        yield str(error)
        return
    ahead = len(backup.shards) - len(manifest.shards)
    known = replace(backup, shards=backup.shards[: len(manifest.shards)])
    if known != manifest or ahead not in (0, 1):
        yield f"{folder / BACKUP} is of another data set: {MEND}"


def _hash_problems(manifest: Manifest, shard: int, columns: Columns) -> Iterator[str]:
    for name, expected in manifest.shards[shard].sha256.items():
        if column_hash(columns[name]) != expected:
            yield f"the SHA-256 of {name} is another than the manifest's"


def _content_problems(manifest: Manifest, shard: int, columns: Columns) -> Iterator[str]:
    """What the numbers themselves must fulfil."""
    for name, values in columns.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            yield f"{name} has values that are not finite"
    yield from _range_problems(manifest.task, columns)
    yield from _episode_problems(manifest, shard, columns)


def _range_problems(task: Task, columns: Columns) -> Iterator[str]:
    ranges = [("action", columns["action"], -1.0, 1.0), ("reward", columns["reward"], 0.0, 1.0)]
    for values in (columns["observation"], columns[EPISODES + "final_observation"]):
        ranges += [
            (feature.name, values[:, i], feature.low, feature.high)
            for i, feature in enumerate(task.features)
            if feature.unit in _BOUNDED
        ]
    for name, values, low, high in ranges:
        if len(values) and not np.float32(low) <= values.min() <= values.max() <= np.float32(high):
            reach = f"goes from {values.min():g} to {values.max():g}"
            yield f"{name} {reach}, beyond [{low:g}, {high:g}]"


def _episode_problems(manifest: Manifest, shard: int, columns: Columns) -> Iterator[str]:
    """Numbers, seeds, starts, lengths and returns fit the settings and each other."""
    settings, rows = manifest.settings, manifest.shards[shard].rows
    own = episode_columns(columns)
    numbers = np.array(settings.shard_range(shard))
    seeds = [episode_seed(settings.seed, int(number)) for number in numbers]
    lengths = own["length"]
    first = np.cumsum(lengths) - lengths
    starts = [manifest.task.start(np.random.default_rng(seed)) for seed in seeds]
    checks: dict[str, tuple[ArrayLike, ArrayLike]] = {
        "episode numbers": (own["episode"], numbers),
        "seeds": (own["seed"], np.array(seeds)),
        "diverged": (own["diverged"], lengths < EPISODE_STEPS),
        "the rows' episode": (columns["episode"], np.repeat(numbers, lengths)),
        "the rows' step": (columns["step"], np.arange(rows) - np.repeat(first, lengths)),
        "returns": (own["return"], episode_returns(columns["reward"], lengths)),
        "initial orientations": (own["initial_qpos"][:, 3:7], [s.quaternion for s in starts]),
        "target positions": (own["target_position"], [s.target_position for s in starts]),
        "target orientations": (own["target_quaternion"], [s.target_quaternion for s in starts]),
    }
    for what, (found, expected) in checks.items():
        if not np.array_equal(found, expected):
            yield f"{what} are not what seeds, lengths and rewards make of them"
