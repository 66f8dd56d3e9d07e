"""Mending a data set: damaged or missing shards, and the manifest, are made again as they were."""

import contextlib
import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

from tqdm import tqdm

from jbrep.collect import LANES, check_counts, simulate_shard
from jbrep.dataset.lock import exclusive
from jbrep.dataset.manifest import (
    MANIFEST,
    Entry,
    Manifest,
    hdf5_files,
    open_shard,
    read_manifest,
    shard_name,
    strangers,
    write_manifest,
    write_shard,
)
from jbrep.dataset.shard import (
    DamageError,
    Shard,
    column_hashes,
    file_hash,
    map_file,
    stored_attributes,
    stored_hashes,
)
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import EPISODE_STEPS
from jbrep.policies import make_policy

_LOST = Entry(0, 0, "", {})  # of a shard that neither manifest nor file tells of


def repair(folder: Path, lanes: int = LANES, num_threads: int | None = None) -> Iterator[str]:
    """Make damaged and missing shards again, and the manifest from the shards if that is gone.

    What isn't part of the data set is set aside under another name, never deleted.

    Yields:
        A line for each thing done.

    Raises:
        InputError: no data set there, or a shard that comes out otherwise than it was: another
            machine or other versions made it.
    """
    check_counts(lanes, num_threads)
    with contextlib.suppress(DamageError):
        read_manifest(folder)
    with exclusive(folder):
        before = None
        try:
            manifest = before = read_manifest(folder)
        except DamageError:
            manifest = _recover(folder)
            yield f"{folder / MANIFEST} read from the shards again"
        for path in strangers(manifest, hdf5_files(folder)):
            aside = _set_aside(path)
            yield f"{path} set aside as {aside.name}: it is not one of the data set's shards"
        for shard in range(len(manifest.shards)):
            if _is_whole(folder, manifest, shard):
                continue
            entry = _make_again(folder, manifest, shard, lanes, num_threads)
            shards = (*manifest.shards[:shard], entry, *manifest.shards[shard + 1 :])
            manifest = replace(manifest, shards=shards)
            yield f"{folder / shard_name(shard)} made again"
        if manifest != before:
            write_manifest(folder, manifest)


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
    with tqdm(total=total, unit="step", unit_scale=True, desc=shard_name(shard)) as progress:
        columns = simulate_shard(
            settings,
            make_policy(settings.policy),
            shard,
            progress.update,
            lanes,
            num_threads,
        )
    if known and column_hashes(columns) != known:
        raise InputError(
            f"{folder / shard_name(shard)} can't be made again here: it comes out otherwise than "
            f"it was with {dict(manifest.versions)}; use these versions and the machine it was "
            "made on"
        )
    return write_shard(folder, manifest, shard, columns)


def _recover(folder: Path) -> Manifest:
    """The manifest that most shards agree on, with an entry for each of them."""
    shards = {
        int(match[1]): path
        for path in folder.glob("shard-*.h5")
        if (match := re.fullmatch(r"shard-(\d{5,})\.h5", path.name))
    }
    stories = Counter(story for path in shards.values() if (story := _story(path)))
    if not stories:
        raise DamageError(f"{folder} can't be repaired: no shard tells how it was collected")
    manifest = Manifest.from_attributes(json.loads(stories.most_common(1)[0][0]))
    known = min(max(shards) + 1, manifest.settings.num_shards)
    entries = (_entry(folder, manifest, shard) for shard in range(known))
    return replace(manifest, shards=tuple(entries))


def _story(path: Path) -> str | None:
    """How a shard says it was collected, as all shards of its data set should say it."""
    try:
        attributes = stored_attributes(path)
        manifest = Manifest.from_attributes(attributes)
        return json.dumps(manifest.attributes(shard=0, rows=0))
    except (DamageError, KeyError, TypeError, ValueError):
        return None


def _entry(folder: Path, manifest: Manifest, shard: int) -> Entry:
    """What a shard's file tells of itself, if it holds."""
    path, specs = folder / shard_name(shard), manifest.settings.specs()
    try:
        content = map_file(path)
        rows = stored_attributes(path)["rows"]
        counts = manifest.row_counts(shard, rows)
        hashes = column_hashes(Shard(path, content, specs, counts))
        whole = stored_hashes(path, specs) == hashes
        told = stored_attributes(path) == manifest.attributes(shard, rows)
    except (DamageError, KeyError, TypeError, ValueError):
        return _LOST
    return Entry(len(content), rows, file_hash(content), hashes) if whole and told else _LOST
