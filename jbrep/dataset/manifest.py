"""What has been committed to a data set's folder; a shard counts once the manifest names it."""

import hashlib
import json
import operator
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from jbrep.dataset import version1
from jbrep.dataset.schema import EPISODES, FORMAT, FORMAT_VERSION, Columns, Spec
from jbrep.dataset.settings import Settings
from jbrep.dataset.shard import (
    REPAIR,
    FileState,
    Shard,
    column_hashes,
    file_hash,
    file_state,
    map_file,
    shard_image,
)
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError, check_version
from jbrep.records.commit import are_commits, commits
from jbrep.records.record import from_plain
from jbrep.records.storage import exists, read_regular, write_whole

MANIFEST = "manifest.json"
BACKUP = "manifest.backup.json"
_PACKAGES = ("jbrep", "mujoco", "numpy", "h5py")
_HASH = "sha256"  # of the rest of the manifest
_MAX_BYTES = 1 << 25  # of a manifest; each shard takes 1.5 kB of it


@dataclass(frozen=True)
class Entry:
    """A committed shard."""

    bytes: int
    rows: int
    episodes: int
    xxh3: str  # of the file
    sha256: Mapping[str, str]  # of each column


@dataclass(frozen=True)
class Manifest:
    """What has been committed to a data set's folder."""

    settings: Settings
    versions: Mapping[str, str]  # of the packages that made it
    shards: tuple[Entry, ...] = ()
    format_version: int = FORMAT_VERSION
    commits: Mapping[str, str] = field(default_factory=dict)  # as `jbrep.records.commit` gives them

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
        if self.format_version == 1:
            return self.episodes == version1.episodes(self.settings)
        return self.rows >= self.settings.steps

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the hashes of all columns: it identifies the data."""
        parts = (f"{name} {digest}\n" for e in self.shards for name, digest in e.sha256.items())
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    def specs(self) -> dict[str, Spec]:
        """The columns of each shard."""
        return self.settings.specs(self.format_version)

    def episode_range(self, shard: int) -> range:
        """Numbers of the episodes in a committed shard."""
        first = shard * self.settings.shard_episodes
        return range(first, first + self.shards[shard].episodes)

    def row_counts(self, shard: int) -> dict[str, int]:
        """Number of rows of each column of a committed shard."""
        entry = self.shards[shard]
        return {n: entry.episodes if n.startswith(EPISODES) else entry.rows for n in self.specs()}

    def extended(self, steps: int) -> "Manifest":
        """The manifest of more steps, before what it lacks is collected.

        If there aren't enough rows, a last shard that isn't full is left out: it has to be made
        again, with more episodes.
        """
        longer = replace(self, settings=replace(self.settings, steps=steps))
        full = self.episodes == len(self.shards) * self.settings.shard_episodes
        return longer if longer.complete or full else replace(longer, shards=self.shards[:-1])

    def is_next(self, other: "Manifest") -> bool:
        """Whether a collector writes the other manifest after this one."""
        more = other.settings.steps > self.settings.steps
        expected = self.extended(other.settings.steps) if more else self
        begun = other.shards in (expected.shards, (*expected.shards, *other.shards[-1:]))
        return begun and other == replace(expected, shards=other.shards)

    def attributes(self, shard: int, rows: int) -> dict[str, Any]:
        """The HDF5 attributes of a shard's file."""
        settings = self.settings.as_json()
        if self.format_version == 1:
            del settings["environment"]
        else:
            settings["environment"] = json.dumps(settings["environment"])
            del settings["steps"]  # a data set with more of them has the same full shards
        return {
            "format": FORMAT,
            "format_version": self.format_version,
            "shard": shard,
            "rows": rows,
            "feature_names": list(self.task.feature_names),
            "feature_units": [feature.unit for feature in self.task.features],
            **settings,
            "policy": json.dumps(self.settings.policy),
            "store_state": int(self.settings.store_state),  # booleans are rare in HDF5
            "versions": json.dumps(self.versions),
        }

    def as_json(self) -> dict[str, Any]:
        """The manifest as plain JSON, in the version of its format."""
        record = {
            "format": FORMAT,
            "format_version": self.format_version,
            "settings": self.settings.as_json(),
            "versions": dict(self.versions),
            **({"commits": dict(self.commits)} if self.commits else {}),
            "shards": [asdict(entry) for entry in self.shards],
        }
        return version1.record(record) if self.format_version == 1 else record


def shard_name(shard: int) -> str:
    """File name of a shard."""
    return f"shard-{shard:05d}.h5"


def new_manifest(settings: Settings) -> Manifest:
    """A manifest without shards, of the installed versions of jbrep's and the environment's."""
    from importlib.metadata import version  # slow to import, and readers don't need it

    from jbrep.envs.names import environment_versions

    versions = {name: version(name) for name in _PACKAGES}
    if not settings.is_imported:  # or else they come from an environment that may not be here
        versions |= environment_versions(settings.task.id)
    return Manifest(settings, versions, commits=dict(commits()))


def read_manifest(folder: Path, name: str = MANIFEST) -> Manifest:
    """Read the manifest of a data set, or its backup, and check every byte of it.

    Raises:
        InputError: there is no data set, or a newer jbrep wrote it.
        DamageError: it isn't what jbrep wrote.
    """
    path = folder / name
    try:
        raw = read_regular(path, _MAX_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        raise _explain_missing(path) from None
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
    damage = DamageError(f"{path} is damaged: it isn't what jbrep wrote; {REPAIR}")
    try:
        record = json.loads(raw)
        if raw != _text(record) or record["format"] != FORMAT:
            raise damage
        version = operator.index(record["format_version"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise damage from None
    check_version(path, version, FORMAT_VERSION)
    try:
        return _parse(version1.mapped(record) if version == 1 else record)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise damage from None


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


def _text(record: dict[str, Any]) -> bytes:
    """The bytes of a record as jbrep writes it; any other byte is damage."""
    body = {key: value for key, value in record.items() if key != _HASH}
    digest = hashlib.sha256(json.dumps(body).encode()).hexdigest()
    return (json.dumps({**body, _HASH: digest}, indent=1) + "\n").encode()


def _parse(record: dict[str, Any]) -> Manifest:
    settings = dict(record["settings"])
    task = from_plain(settings.pop("environment"), Task)
    if settings.pop("task") != task.name:
        raise ValueError
    shards = tuple(Entry(**entry) for entry in record["shards"])
    versions = record["versions"]
    if not set(_PACKAGES) <= set(versions):
        raise ValueError
    if not all(
        re.fullmatch(r"[\w.+!-]+", word, re.ASCII) for each in versions.items() for word in each
    ):
        raise ValueError
    version, known = record["format_version"], record.get("commits", {})
    if not are_commits(known):
        raise ValueError
    manifest = Manifest(Settings(task=task, **settings), versions, shards, version, known)
    _check_shards(manifest)
    return manifest


def _check_shards(manifest: Manifest) -> None:
    """Make sure that the shards' numbers are possible, all but the last one full."""
    columns, full = set(manifest.specs()), manifest.settings.shard_episodes
    for shard, entry in enumerate(manifest.shards):
        episodes, last = operator.index(entry.episodes), shard == len(manifest.shards) - 1
        most = manifest.task.max_episode_steps * episodes
        if not (episodes == full or (last and 1 <= episodes <= full)):
            raise ValueError
        if operator.index(entry.bytes) < 0 or not 0 <= operator.index(entry.rows) <= most:
            raise ValueError
        if entry.sha256.keys() != columns:
            raise ValueError


def open_shard(
    folder: Path, manifest: Manifest, shard: int, checked: set[FileState] | None = None
) -> Shard:
    """Open a shard once its bytes have been checked against the manifest.

    Args:
        folder: of the data set.
        manifest: with the size and the hash of the shard.
        shard: its number.
        checked: states of files that have been checked before; this one's is added. A file in one
            of these states isn't hashed again.

    Raises:
        DamageError: the bytes differ, or the file is missing.
    """
    path, entry = folder / shard_name(shard), manifest.shards[shard]
    state = file_state(path)  # before it is mapped: a file replaced in between is hashed again
    content = map_file(path)
    if checked is None or state not in checked:
        if len(content) != entry.bytes or file_hash(content) != entry.xxh3:
            raise DamageError(
                f"{path} is damaged: its {len(content):,} bytes aren't the {entry.bytes:,} bytes "
                f"that were committed; {REPAIR}"
            )
        if checked is not None:
            checked.add(state)
    return Shard(
        path, content, manifest.specs(), manifest.row_counts(shard), manifest.task.max_episode_steps
    )


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
        path = folder / shard_name(shard)
        try:
            size = path.lstat().st_size
        except FileNotFoundError:
            yield f"{path} is missing: {REPAIR}"
            continue
        if size != entry.bytes:
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
    """Write the next shard, then the manifest that names it.

    Raises:
        InputError: it can't be written.
    """
    shard = len(manifest.shards)
    entry = write_shard(folder, manifest, shard, columns)
    manifest = replace(manifest, shards=(*manifest.shards, entry))
    write_manifest(folder, manifest)
    return manifest


def write_shard(folder: Path, manifest: Manifest, shard: int, columns: Columns) -> Entry:
    """Write a shard's file; it counts once a manifest names it.

    Raises:
        InputError: it can't be written.
    """
    rows, episodes = len(columns["step"]), len(columns[EPISODES + "length"])
    hashes = column_hashes(columns)
    image = shard_image(columns, hashes, manifest.attributes(shard, rows))
    write_whole(folder / shard_name(shard), image)
    return Entry(len(image), rows, episodes, file_hash(image), hashes)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the backup, then the manifest, in place of the previous ones.

    Raises:
        InputError: it can't be written.
    """
    for name in (BACKUP, MANIFEST):
        write_whole(folder / name, _text(manifest.as_json()))
