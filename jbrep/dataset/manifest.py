"""What has been committed to a data set's folder; a shard counts once the manifest names it."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from jbrep.dataset.schema import EPISODES, Columns, DataSettings, joined
from jbrep.dataset.shard import (
    REPAIR,
    Checked,
    Shard,
    column_hashes,
    file_hash,
    file_state,
    map_file,
    shard_image,
)
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError
from jbrep.records.commit import Commits, commits
from jbrep.records.document import Document, document_from, parse_json
from jbrep.records.record import Record, Sha256, Version
from jbrep.records.storage import MissingFileError, exists, read_file, write_whole

MANIFEST = "manifest.json"
BACKUP = "manifest.backup.json"
_PACKAGES = ("jbrep", "mujoco", "numpy", "h5py")
_HASH = "sha256"  # of the rest of the manifest

_Count = Annotated[int, Meta(ge=1, le=1 << 62)]


class Entry(Record, frozen=True, kw_only=True):
    """A committed shard."""

    bytes: _Count
    rows: _Count
    episodes: _Count
    xxh3: Annotated[str, Meta(pattern=r"\A[0-9a-f]{32}\Z")]  # of the file
    sha256: Mapping[str, Sha256]  # of each column


class Manifest(Document, frozen=True, kw_only=True):
    """What has been committed to a data set's folder."""

    format: ClassVar[str] = "jbrep data set"
    format_version: ClassVar[int] = 3
    indent: ClassVar[int] = 1

    settings: DataSettings
    versions: Mapping[Version, Version]  # of the packages that made it
    commits: Commits = {}
    shards: tuple[Entry, ...] = ()

    def check(self) -> None:
        """As for `Record`: the shards' numbers are possible, all but the last one full."""
        if missing := set(_PACKAGES) - set(self.versions):
            raise InputError(f"versions.{min(missing)} is missing")
        columns, full = set(self.settings.specs()), self.settings.shard_episodes
        for shard, entry in enumerate(self.shards):
            is_last = shard == len(self.shards) - 1
            if not (entry.episodes == full or (is_last and entry.episodes < full)):
                raise InputError(f"shard {shard} has {entry.episodes:,} episodes, not {full:,}")
            if not entry.episodes <= entry.rows <= self.task.max_episode_steps * entry.episodes:
                raise InputError(f"shard {shard} can't have {entry.rows:,} rows")
            if entry.sha256.keys() != columns:
                raise InputError(f"shard {shard} has other columns than the settings ask for")

    @property
    def task(self) -> Task:
        """The task whose features the observations hold."""
        return self.settings.task

    @property
    def rows(self) -> int:
        """Number of rows committed."""
        return sum(entry.rows for entry in self.shards)

    @property
    def episodes(self) -> int:
        """Number of episodes committed."""
        return sum(entry.episodes for entry in self.shards)

    @property
    def complete(self) -> bool:
        """Whether all that the settings ask for has been committed."""
        return self.rows >= self.settings.steps

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the hashes of all columns: it identifies the data."""
        parts = (f"{name} {digest}\n" for e in self.shards for name, digest in e.sha256.items())
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    def extended(self, steps: int) -> "Manifest":
        """The manifest of so many steps, before what it lacks is collected."""
        return self.replace(settings=self.settings.replace(steps=steps))

    @property
    def full_shards(self) -> int:
        """Number of shards that no episode is added to."""
        return self.episodes // self.settings.shard_episodes

    def is_next(self, other: "Manifest") -> bool:
        """Whether a collector writes the other manifest after this one."""
        more = max(self.settings.steps, other.settings.steps)
        kept, added = self.shards[: self.full_shards], other.shards[self.full_shards :]
        begun = other.shards == self.shards or (
            other.shards[: self.full_shards] == kept
            and len(added) == 1
            and other.episodes > self.episodes
        )
        return begun and other == self.extended(more).replace(shards=other.shards)

    def attributes(self, shard: int, rows: int) -> dict[str, Any]:
        """The HDF5 attributes of a shard's file."""
        settings = self.settings.as_json()
        del settings["steps"]  # a data set with more of them has the same full shards
        return {
            "format": self.format,
            "format_version": self.format_version,
            "shard": shard,
            "rows": rows,
            "feature_names": list(self.task.feature_names),
            "feature_units": [feature.unit for feature in self.task.features],
            **settings,
            "environment": json.dumps(settings["environment"]),
            "policy": json.dumps(settings["policy"]),
            "store_state": int(self.settings.store_state),  # booleans are rare in HDF5
            "versions": json.dumps(dict(self.versions)),
        }

    def as_json(self) -> dict[str, Any]:
        """The manifest as plain JSON, with the name of the task and only commits that there are."""
        plain = {**super().as_json(), "settings": self.settings.as_json()}
        return plain if self.commits else {n: v for n, v in plain.items() if n != "commits"}

    def text(self) -> str:
        """The text of its file, with a hash of all the rest."""
        return _hashed(self.as_json())


def _hashed(plain: dict[str, Any]) -> str:
    """The text of a manifest's file as jbrep writes it; any other byte is damage."""
    body = {key: value for key, value in plain.items() if key != _HASH}
    digest = hashlib.sha256(json.dumps(body).encode()).hexdigest()
    return json.dumps({**body, _HASH: digest}, indent=Manifest.indent) + "\n"


def shard_name(shard: int) -> str:
    """File name of a shard."""
    return f"shard-{shard:05d}.h5"


def new_manifest(settings: DataSettings, source: Manifest | None = None) -> Manifest:
    """A manifest without shards, of the installed versions of jbrep's and the environment's.

    Args:
        settings: of the data set.
        source: of the data that it is derived from, which know the versions of the environment:
            that need not be here then.
    """
    from importlib.metadata import version  # slow to import, and readers don't need it

    from jbrep.envs.names import environment_versions

    versions = {name: version(name) for name in _PACKAGES}
    if source:
        versions = {**source.versions, **versions}
    elif not settings.is_imported:  # or else they come from an environment that may not be here
        versions |= environment_versions(settings.task)
    return Manifest(settings=settings, versions=versions, commits=dict(commits()))


def read_manifest(folder: Path, name: str = MANIFEST) -> Manifest:
    """Read the manifest of a data set, or its backup, and check every byte of it.

    Raises:
        DamageError: it isn't what jbrep wrote.
    """
    path = folder / name
    try:
        return _manifest_from(read_file(path), path)
    except MissingFileError:
        raise _explain_missing(path) from None
    except DamageError as error:
        raise DamageError(f"{error}; {REPAIR}") from None


def current_manifest(folder: Path) -> Manifest:
    """The manifest of what is in the folder, as `read_manifest` reads it.

    It is the backup, if a collector was killed, or is at work, between the last shard and the
    manifest that names it.
    """
    manifest = read_manifest(folder)
    count = len(manifest.shards)
    is_added = _size(folder, count) is not None
    is_other = count > 0 and _size(folder, count - 1) not in (None, manifest.shards[-1].bytes)
    if is_added or is_other:
        with suppress(InputError):
            backup = read_manifest(folder, BACKUP)
            size = _size(folder, len(backup.shards) - 1)
            if manifest.is_next(backup) and backup.shards and backup.shards[-1].bytes == size:
                return backup
    return manifest


def _size(folder: Path, shard: int) -> int | None:
    try:
        return (folder / shard_name(shard)).lstat().st_size
    except OSError:
        return None


def _manifest_from(raw: bytes, path: Path) -> Manifest:
    plain = parse_json(raw, path, Manifest.format)
    damage = DamageError(f"{path} is damaged: it isn't what jbrep wrote")
    if raw != _hashed(plain).encode():
        raise damage
    del plain[_HASH]
    settings = plain.get("settings")
    if isinstance(settings, dict):  # which have the task's name besides
        settings = {name: value for name, value in settings.items() if name != "task"}
    manifest = document_from({**plain, "settings": settings}, path, Manifest)
    if manifest.as_json() != plain:
        raise damage
    return manifest


def _explain_missing(path: Path) -> InputError:
    """The error for a manifest, or its backup, that isn't there: with what helps."""
    folder, other = path.parent, BACKUP if path.name == MANIFEST else MANIFEST
    files = hdf5_files(folder)
    if exists(folder / other):
        if path.name == MANIFEST and not files and _is_empty_backup(folder):
            return InputError(
                f"nothing has been collected in {folder} yet: run the same jbrep collect again"
            )
        return DamageError(f"{path} is missing: {REPAIR}")
    if files:
        return DamageError(
            f"{folder} has {len(files)} HDF5 files but neither {MANIFEST} nor {BACKUP}, without "
            "which they can't be checked: collect again in another folder"
        )
    return InputError(f"no data set in {folder}: expected a folder that jbrep collect wrote")


def _is_empty_backup(folder: Path) -> bool:
    """Whether the collector was killed before its first manifest, once the backup was there."""
    try:
        return not read_manifest(folder, BACKUP).shards
    except InputError:
        return False


def open_shard(
    folder: Path, manifest: Manifest, shard: int, checked: set[Checked] | None = None
) -> Shard:
    """Open a shard once its bytes have been checked against the manifest.

    Args:
        folder: of the data set.
        manifest: with the size and the hash of the shard.
        shard: its number.
        checked: shards that have been checked before, with the states that their files were in;
            this one is added. A file in one of these states isn't hashed again.

    Raises:
        DamageError: the bytes differ, or the file is missing.
    """
    path, entry = folder / shard_name(shard), manifest.shards[shard]
    state = file_state(path)  # before it is mapped: a file replaced in between is hashed again
    content = map_file(path)
    if checked is None or (shard, state) not in checked:
        if len(content) != entry.bytes or file_hash(content) != entry.xxh3:
            raise DamageError(
                f"{path} is damaged: its content isn't what was committed: its checksum doesn't "
                f"match; {REPAIR}"
            )
        if checked is not None:
            checked.add((shard, state))
    specs, most = manifest.settings.specs(), manifest.task.max_episode_steps
    return Shard(path, content, specs, entry.rows, entry.episodes, most)


def hdf5_files(folder: Path) -> list[Path]:
    """The files that should be shards.

    List them before reading the manifest: it then names all those that a collector has committed.
    """
    try:
        return sorted(folder.glob("*.h5"))
    except OSError:
        return []  # the manifest can't be read either


def check_files(folder: Path, manifest: Manifest, files: list[Path]) -> None:
    """Check that the files are the shards of the manifest, by name and size.

    Raises:
        DamageError: one is missing, has another size, or isn't in the manifest.
    """
    for problem in file_problems(folder, manifest, files):
        raise DamageError(problem)


def file_problems(folder: Path, manifest: Manifest, files: list[Path]) -> Iterator[str]:
    """What `check_files` raises, as a line for each file."""
    for shard, entry in enumerate(manifest.shards):
        path, size = folder / shard_name(shard), _size(folder, shard)
        if size is None:
            yield f"{path} is missing: {REPAIR}"
        elif size != entry.bytes:
            yield (f"{path} is damaged: it has {size:,} bytes instead of {entry.bytes:,}; {REPAIR}")
    for path in unlisted_files(manifest, files):
        yield f"{path} is not one of the {len(manifest.shards)} shards of the data set"


def unlisted_files(manifest: Manifest, files: list[Path]) -> list[Path]:
    """Files that are neither in the manifest nor the shard being committed."""
    known = {shard_name(shard) for shard in range(len(manifest.shards))}
    if not manifest.complete:
        known.add(shard_name(len(manifest.shards)))
    return [path for path in files if path.name not in known]


def commit(folder: Path, manifest: Manifest, columns: Columns) -> Manifest:
    """Add episodes to the last shard, or begin another one if that is full.

    At every moment the manifest or its backup names what is there, see `current_manifest`.

    Args:
        folder: of the data set.
        manifest: of what is there.
        columns: of the episodes, no more than the shard lacks.

    Returns:
        The manifest that names them, too.
    """
    shard = manifest.full_shards
    if shard < len(manifest.shards):
        columns = joined([dict(open_shard(folder, manifest, shard)), columns])
    entry, image = _entry_and_image(manifest, shard, columns)
    manifest = manifest.replace(shards=(*manifest.shards[:shard], entry))
    manifest.write(folder / BACKUP)
    write_whole(folder / shard_name(shard), image)
    manifest.write(folder / MANIFEST)
    return manifest


def write_shard(folder: Path, manifest: Manifest, shard: int, columns: Columns) -> Entry:
    """Write a shard's file; it counts once a manifest names it."""
    entry, image = _entry_and_image(manifest, shard, columns)
    write_whole(folder / shard_name(shard), image)
    return entry


def _entry_and_image(manifest: Manifest, shard: int, columns: Columns) -> tuple[Entry, bytes]:
    """What the manifest says of a shard, and the bytes of its file."""
    rows, episodes = len(columns["step"]), len(columns[EPISODES + "length"])
    hashes = column_hashes(columns)
    image = shard_image(columns, hashes, manifest.attributes(shard, rows))
    entry = Entry(
        bytes=len(image), rows=rows, episodes=episodes, xxh3=file_hash(image), sha256=hashes
    )
    return entry, image


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the backup, then the manifest, in place of the previous ones."""
    for name in (BACKUP, MANIFEST):
        manifest.write(folder / name)
