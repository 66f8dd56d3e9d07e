"""Repairing a data set: damaged or missing files are restored as they were."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from jbrep.collect.policies import Policy, make_policy
from jbrep.collect.shards import LANES, Simulator
from jbrep.dataset.manifest import (
    BACKUP,
    MANIFEST,
    Entry,
    Manifest,
    current_manifest,
    hdf5_files,
    open_shard,
    read_manifest,
    shard_name,
    unlisted_files,
    write_manifest,
    write_shard,
)
from jbrep.dataset.shard import column_hashes
from jbrep.dataset.verify import policy_files
from jbrep.envs.lanes import check_counts
from jbrep.errors import DamageError, InputError
from jbrep.progress import Progress
from jbrep.records.lock import exclusive


def repair(
    folder: Path,
    lanes: int = LANES,
    num_threads: int | None = None,
    make: Callable[[Mapping[str, Any]], Policy] = make_policy,
) -> Iterator[str]:
    """Simulate damaged and missing shards again, and restore the manifest from its backup.

    A damaged backup is restored from the manifest. A file that isn't part of the data set is
    renamed, never deleted.

    Args:
        folder: of the data set.
        lanes: robots stepped at once.
        num_threads: threads to step them on; None takes one for each core.
        make: makes the policy from what the manifest says of it.

    Yields:
        A line for each file restored or renamed.
    """
    check_counts(lanes, num_threads)
    intact = _intact_manifest(folder)
    with exclusive(folder):
        manifest = current_manifest(folder) if intact == MANIFEST else read_manifest(folder, intact)
        for path in unlisted_files(manifest, hdf5_files(folder)):
            aside = _set_aside(path)
            yield f"{path} renamed to {aside.name}: it is not one of the data set's shards"
        for shard in range(len(manifest.shards)):
            if _is_intact(folder, manifest, shard):
                continue
            entry = _restore(folder, manifest, shard, lanes, num_threads, make)
            shards = (*manifest.shards[:shard], entry, *manifest.shards[shard + 1 :])
            manifest = manifest.replace(shards=shards)
            yield f"{folder / shard_name(shard)} restored"
        if not _is_backed_up(folder, manifest):
            write_manifest(folder, manifest)
            yield f"{folder / MANIFEST} and its backup restored"
        policy_files(folder, manifest)


def _intact_manifest(folder: Path) -> str:
    """The name of the manifest, or of its backup if the manifest is damaged.

    Raises:
        DamageError: both are damaged.
    """
    for name in (MANIFEST, BACKUP):
        with suppress(DamageError):
            read_manifest(folder, name)
            return name
    raise DamageError(
        f"{folder} can't be repaired: {MANIFEST} and {BACKUP} are both damaged or missing; collect "
        "again in another folder"
    )


def _is_backed_up(folder: Path, manifest: Manifest) -> bool:
    try:
        return read_manifest(folder) == read_manifest(folder, BACKUP) == manifest
    except InputError:
        return False


def _set_aside(path: Path) -> Path:
    """Rename a file to an unused name."""
    names = (f"{path.name}.unlisted{number or ''}" for number in count())
    aside = next(path.with_name(name) for name in names if not path.with_name(name).exists())
    return path.rename(aside)


def _is_intact(folder: Path, manifest: Manifest, shard: int) -> bool:
    try:
        dict(open_shard(folder, manifest, shard))
    except DamageError:
        return False
    return True


def _restore(
    folder: Path,
    manifest: Manifest,
    shard: int,
    lanes: int,
    num_threads: int | None,
    make: Callable[[Mapping[str, Any]], Policy],
) -> Entry:
    settings, entry, path = manifest.settings, manifest.shards[shard], folder / shard_name(shard)
    if settings.is_imported:
        raise InputError(
            f"{path} can't be restored: the data set was imported; import its source, "
            f"{settings.policy['source']}, again in another folder"
        )
    if settings.reward:
        raise InputError(
            f"{path} can't be restored: {settings.reward} gave the rewards; derive the data set "
            "again in another folder"
        )
    if not settings.task.reproducible:
        raise InputError(
            f"{path} can't be restored: {settings.task.name} is not reproducible, the same seed "
            "and actions lead to other states; collect again in another folder"
        )
    with Progress(total=entry.rows, unit="step", unit_scale=True, desc=path.name) as progress:
        simulator = Simulator(settings, make(settings.policy), lanes, num_threads)
        try:
            columns = simulator.shard(shard, progress.update, most_episodes=entry.episodes)
        except InputError as error:
            again = "; derive the data set again in another folder" if settings.task.view else ""
            raise InputError(f"{path} can't be restored: {error}{again}") from None
    if column_hashes(columns) != entry.sha256:
        raise InputError(
            f"{path} can't be restored here: it comes out differently; use the robot as it was, on "
            f"the machine it was made on, with these versions: {dict(manifest.versions)}"
        )
    return write_shard(folder, manifest, shard, columns)
