"""Mending a data set: damaged or missing files are made again as they were."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path

from jbrep.collect.collector import LANES, simulate_shard
from jbrep.collect.policies import make_policy
from jbrep.dataset.manifest import (
    BACKUP,
    MANIFEST,
    Entry,
    Manifest,
    hdf5_files,
    open_shard,
    read_manifest,
    shard_name,
    unlisted_files,
    write_manifest,
    write_shard,
)
from jbrep.dataset.shard import column_hashes
from jbrep.errors import DamageError, InputError
from jbrep.files.lock import exclusive
from jbrep.jitterbug.simulation import check_counts
from jbrep.jitterbug.tasks import EPISODE_STEPS
from jbrep.progress import Progress


def repair(folder: Path, lanes: int = LANES, num_threads: int | None = None) -> Iterator[str]:
    """Make damaged and missing shards again, and the manifest from its backup or the other way.

    What isn't part of the data set is set aside under another name, never deleted.

    Yields:
        A line for each thing done.

    Raises:
        InputError: no data set there, or a shard that comes out otherwise than it was: another
            machine or other versions made it.
    """
    check_counts(lanes, num_threads)
    good = _good_manifest(folder)
    with exclusive(folder):
        manifest = before = read_manifest(folder, good)
        for path in unlisted_files(manifest, hdf5_files(folder)):
            aside = _set_aside(path)
            yield f"{path} set aside as {aside.name}: it is not one of the data set's shards"
        for shard in range(len(manifest.shards)):
            if _is_whole(folder, manifest, shard):
                continue
            entry = _make_again(folder, manifest, shard, lanes, num_threads)
            shards = (*manifest.shards[:shard], entry, *manifest.shards[shard + 1 :])
            manifest = replace(manifest, shards=shards)
            yield f"{folder / shard_name(shard)} made again"
        if manifest != before or not _is_double(folder, manifest):
            write_manifest(folder, manifest)
            yield f"{folder / MANIFEST} and its backup written again"


def _good_manifest(folder: Path) -> str:
    """The name of the manifest, or of its backup where that is damaged.

    Raises:
        DamageError: both are.
    """
    for name in (MANIFEST, BACKUP):
        with suppress(DamageError):
            read_manifest(folder, name)
            return name
    raise DamageError(
        f"{folder} can't be repaired: {MANIFEST} and {BACKUP} are both damaged or missing; collect "
        "it again in another folder"
    )


def _is_double(folder: Path, manifest: Manifest) -> bool:
    try:
        return read_manifest(folder) == read_manifest(folder, BACKUP) == manifest
    except InputError:
        return False


def _set_aside(path: Path) -> Path:
    """Rename a file to a name that is free."""
    names = (f"{path.name}.unlisted{number or ''}" for number in count())
    aside = next(path.with_name(name) for name in names if not path.with_name(name).exists())
    return path.rename(aside)


def _is_whole(folder: Path, manifest: Manifest, shard: int) -> bool:
    try:
        dict(open_shard(folder, manifest, shard))
    except DamageError:
        return False
    return True


def _make_again(
    folder: Path, manifest: Manifest, shard: int, lanes: int, num_threads: int | None
) -> Entry:
    settings, known = manifest.settings, manifest.shards[shard].sha256
    total = len(settings.shard_range(shard)) * EPISODE_STEPS
    with Progress(total=total, unit="step", unit_scale=True, desc=shard_name(shard)) as progress:
        columns = simulate_shard(
            settings,
            make_policy(settings.policy),
            shard,
            progress.update,
            lanes,
            num_threads,
        )
    if column_hashes(columns) != known:
        raise InputError(
            f"{folder / shard_name(shard)} can't be made again here: it comes out otherwise than "
            f"it was with {dict(manifest.versions)}; use these versions and the machine it was "
            "made on"
        )
    return write_shard(folder, manifest, shard, columns)
