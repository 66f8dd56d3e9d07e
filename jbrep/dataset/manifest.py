"""What has been committed to a data set's folder; a shard counts once the manifest names it."""

import hashlib
import json
import math
import operator
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from jbrep.dataset.schema import (
    EPISODES,
    FORMAT,
    FORMAT_VERSION,
    Columns,
    Spec,
    all_specs,
    check_root_seed,
    step_specs,
)
from jbrep.dataset.shard import (
    MEND,
    Shard,
    column_hashes,
    file_hash,
    map_file,
    shard_image,
)
from jbrep.errors import DamageError, InputError, check_version
from jbrep.files.storage import read_regular, write_whole
from jbrep.jitterbug.tasks import EPISODE_STEPS, Task, get_task

MANIFEST = "manifest.json"
BACKUP = "manifest.backup.json"
_PACKAGES = ("jbrep", "mujoco", "numpy", "h5py")
_HASH = "sha256"  # of all else in the manifest
_MAX_STEPS = 10**12  # episodes have 32-bit numbers
_MAX_BYTES = 1 << 25  # of a manifest; a shard takes 1.5 kB of it
_MAX_SHARDS = 10_000
_MAX_SHARD_EPISODES = 10_000


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the data, and how it is cut into shards."""

    task: str
    policy: Mapping[str, Any] = field(default_factory=lambda: {"kind": "uniform"})  # and constants
    steps: int  # asked for; rounded up to whole episodes
    seed: int = 0  # the root of all episodes' seeds
    shard_episodes: int = 100
    store_state: bool = False

    def check(self) -> None:
        """Make sure that it can be collected.

        Raises:
            InputError: unknown task, a seed out of range, or a number below 1.
            TypeError: a value of another type.
        """
        get_task(self.task)
        check_root_seed(operator.index(self.seed))
        for count, most, what in (
            (self.steps, _MAX_STEPS, "steps"),
            (self.shard_episodes, _MAX_SHARD_EPISODES, "episodes in a shard"),
        ):
            if not 1 <= operator.index(count) <= most:
                raise InputError(f"the number of {what} is {count}: it must be from 1 to {most:,}")
        if self.num_shards > _MAX_SHARDS:
            raise InputError(
                f"{self.num_shards:,} shards are more than {_MAX_SHARDS:,}: put more than "
                f"{self.shard_episodes} episodes in a shard"
            )
        if type(self.store_state) is not bool or not _is_policy(self.policy):
            raise TypeError

    @property
    def episodes(self) -> int:
        """How many episodes."""
        return -(-self.steps // EPISODE_STEPS)

    @property
    def num_shards(self) -> int:
        """How many shards hold them."""
        return -(-self.episodes // self.shard_episodes)

    def shard_range(self, shard: int) -> range:
        """The episodes in a shard."""
        start = shard * self.shard_episodes
        return range(start, min(start + self.shard_episodes, self.episodes))

    def specs(self) -> dict[str, Spec]:
        """The columns of each shard."""
        return all_specs(get_task(self.task), self.store_state)

    def row_bytes(self) -> int:
        """Bytes that a control step takes."""
        specs = step_specs(get_task(self.task), self.store_state).values()
        return sum(spec.dtype.itemsize * math.prod(spec.row) for spec in specs)


@dataclass(frozen=True)
class Entry:
    """A committed shard."""

    bytes: int
    rows: int
    xxh3: str  # of the file
    sha256: Mapping[str, str]  # of each column


@dataclass(frozen=True)
class Manifest:
    """What a data set's folder holds."""

    settings: Settings
    versions: Mapping[str, str]  # of the packages that made it
    shards: tuple[Entry, ...] = ()

    @property
    def task(self) -> Task:
        """The task whose features the observations hold."""
        return get_task(self.settings.task)

    @property
    def complete(self) -> bool:
        """Whether every shard has been committed."""
        return len(self.shards) == self.settings.num_shards

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the hashes of all columns: it names the data."""
        parts = (f"{name} {digest}\n" for e in self.shards for name, digest in e.sha256.items())
        return hashlib.sha256("".join(parts).encode()).hexdigest()

    def row_counts(self, shard: int, rows: int) -> dict[str, int]:
        """How many rows each column of a shard has."""
        episodes = len(self.settings.shard_range(shard))
        return {n: episodes if n.startswith(EPISODES) else rows for n in self.settings.specs()}

    def attributes(self, shard: int, rows: int) -> dict[str, Any]:
        """What a shard's file says of itself."""
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "shard": shard,
            "rows": rows,
            "feature_names": list(self.task.feature_names),
            "feature_units": [feature.unit for feature in self.task.features],
            **asdict(self.settings),
            "policy": json.dumps(self.settings.policy),
            "store_state": int(self.settings.store_state),  # booleans are rare in HDF5
            "versions": json.dumps(self.versions),
        }


def _is_policy(settings: Mapping[str, Any]) -> bool:
    """A kind, which is a word, and numbers."""
    constants = {name: value for name, value in settings.items() if name != "kind"}
    return re.fullmatch("[a-z-]+", settings["kind"]) is not None and all(
        type(value) in (int, float) and abs(value) < _MAX_STEPS for value in constants.values()
    )


def shard_name(shard: int) -> str:
    """File name of the shard of that number."""
    return f"shard-{shard:05d}.h5"


def new_manifest(settings: Settings) -> Manifest:
    """A manifest without shards, of the versions that are installed."""
    from importlib.metadata import version  # not at the top: readers needn't wait for it

    return Manifest(settings, {name: version(name) for name in _PACKAGES})


def read_manifest(folder: Path, name: str = MANIFEST) -> Manifest:
    """The manifest of a data set, or its backup, checked to the last bit.

    Raises:
        InputError: no data set there, or one that a newer jbrep wrote.
        DamageError: not what jbrep wrote.
    """
    path = folder / name
    try:
        raw = read_regular(path, _MAX_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        if (folder / BACKUP).exists() or any(hdf5_files(folder)):
            raise DamageError(f"{path} is missing: {MEND}") from None
        raise InputError(
            f"no data set in {folder}: a folder that jbrep collect wrote is expected"
        ) from None
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
    damage = DamageError(f"{path} is damaged: it isn't what jbrep wrote; {MEND}")
    try:
        record = json.loads(raw)
        if raw != _text(record) or record["format"] != FORMAT:
            raise damage
        version = operator.index(record["format_version"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise damage from None
    check_version(path, version, FORMAT_VERSION)
    try:
        return _parse(record)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise damage from None


def _text(record: dict[str, Any]) -> bytes:
    """The one way to write a record: any other byte is damage."""
    body = {key: value for key, value in record.items() if key != _HASH}
    digest = hashlib.sha256(json.dumps(body).encode()).hexdigest()
    return (json.dumps({**body, _HASH: digest}, indent=1) + "\n").encode()


def _parse(record: dict[str, Any]) -> Manifest:
    settings = Settings(**record["settings"])
    settings.check()
    shards = tuple(Entry(**entry) for entry in record["shards"])
    columns = set(settings.specs())
    if len(shards) > settings.num_shards or any(e.sha256.keys() != columns for e in shards):
        raise ValueError
    for shard, entry in enumerate(shards):
        most = EPISODE_STEPS * len(settings.shard_range(shard))
        if operator.index(entry.bytes) < 0 or not 0 <= operator.index(entry.rows) <= most:
            raise ValueError
    versions = record["versions"]
    if set(versions) != set(_PACKAGES):
        raise ValueError
    if not all(re.fullmatch(r"[\w.+!-]+", number, re.ASCII) for number in versions.values()):
        raise ValueError
    return Manifest(settings, versions, shards)


def open_shard(
    folder: Path, manifest: Manifest, shard: int, known: set[tuple[int, ...]] | None = None
) -> Shard:
    """A shard's columns, once its bytes are found to be those committed.

    Args:
        folder: of the data set.
        manifest: which bytes they are.
        shard: its number.
        known: marks of files that were found so before, to be added to: while a file stays the
            same one, it isn't read through again.

    Raises:
        DamageError: they aren't, or it is missing.
    """
    path, entry = folder / shard_name(shard), manifest.shards[shard]
    content = map_file(path)
    status = path.stat()
    mark = (shard, status.st_ino, status.st_size, status.st_mtime_ns)
    if known is None or mark not in known:
        if len(content) != entry.bytes or file_hash(content) != entry.xxh3:
            raise DamageError(
                f"{path} is damaged: {len(content):,} bytes that aren't the {entry.bytes:,} that "
                f"were committed; {MEND}"
            )
        if known is not None:
            known.add(mark)
    return Shard(path, content, manifest.settings.specs(), manifest.row_counts(shard, entry.rows))


def hdf5_files(folder: Path) -> list[Path]:
    """The files that should be shards; list them before the manifest is read.

    Then whatever a collector commits in between is in the manifest at least.
    """
    try:
        return sorted(folder.glob("*.h5"))
    except OSError:
        return []  # the manifest can't be read either


def check_files(folder: Path, manifest: Manifest, files: list[Path]) -> None:
    """Make sure that the files are the shards of the manifest, by name and size.

    Raises:
        DamageError: one is missing, cut short, or not one of them.
    """
    for problem in file_problems(folder, manifest, files):
        raise DamageError(problem)


def file_problems(folder: Path, manifest: Manifest, files: list[Path]) -> Iterator[str]:
    """What `check_files` finds wrong, a line for each file."""
    for shard, entry in enumerate(manifest.shards):
        path = folder / shard_name(shard)
        try:
            size = path.lstat().st_size
        except FileNotFoundError:
            yield f"{path} is missing: {MEND}"
            continue
        if size != entry.bytes:
            yield (
                f"{path} is damaged: it has {size:,} bytes, {entry.bytes:,} were committed; {MEND}"
            )
    for path in unlisted_files(manifest, files):
        yield f"{path} is not one of the {len(manifest.shards)} shards of the data set"


def unlisted_files(manifest: Manifest, files: list[Path]) -> list[Path]:
    """Files that the manifest doesn't name, nor are they the shard whose commit is under way."""
    known = {shard_name(shard) for shard in range(len(manifest.shards))}
    if not manifest.complete:
        known.add(shard_name(len(manifest.shards)))
    return [path for path in files if path.name not in known]


def commit(folder: Path, manifest: Manifest, columns: Columns) -> Manifest:
    """Write the next shard, then the manifest that names it.

    Raises:
        InputError: it can't be written; the message says where and how much.
    """
    shard = len(manifest.shards)
    entry = write_shard(folder, manifest, shard, columns)
    manifest = replace(manifest, shards=(*manifest.shards, entry))
    write_manifest(folder, manifest)
    return manifest


def write_shard(folder: Path, manifest: Manifest, shard: int, columns: Columns) -> Entry:
    """Write a shard's file; it doesn't count before a manifest names it.

    Raises:
        InputError: it can't be written.
    """
    rows = len(columns["step"])
    hashes = column_hashes(columns)
    image = shard_image(columns, hashes, manifest.attributes(shard, rows))
    write_whole(folder / shard_name(shard), image)
    return Entry(len(image), rows, file_hash(image), hashes)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Put the manifest in place of the one before, and its backup, which is written first.

    Raises:
        InputError: it can't be written.
    """
    record = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(manifest)}
    for name in (BACKUP, MANIFEST):
        write_whole(folder / name, _text(record))
