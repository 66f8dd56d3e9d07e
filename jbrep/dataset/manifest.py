"""A data set's folder: shards of whole episodes, and the manifest that lists them.

A shard is an HDF5 file of flat columns. jbrep itself needs no HDF5 to read one: the manifest says
where each column begins.
"""

import hashlib
import json
import mmap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from jbrep.dataset.schema import EPISODES, Columns, DataSettings
from jbrep.dataset.settings import TRAINED, parts_of
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError, refusing
from jbrep.progress import Progress
from jbrep.records.commit import Commits, commits
from jbrep.records.document import Document, document_from, parse_json
from jbrep.records.record import Record, Sha256, Version
from jbrep.records.storage import exists, read_file, write_whole

MANIFEST = "manifest.json"
AGAIN = "collect or import the data again in another folder"
_HASH = "sha256"  # of all else in the manifest
_PACKAGES = ("jbrep", "mujoco", "numpy", "h5py")

_Count = Annotated[int, Meta(ge=1)]


class Entry(Record, frozen=True, kw_only=True):
    """A shard."""

    bytes: _Count
    rows: _Count
    episodes: _Count
    sha256: Sha256  # of the file
    offsets: Mapping[str, Annotated[int, Meta(ge=0)]]  # where each column begins [bytes]


class Manifest(Document, frozen=True, kw_only=True):
    """What is in a data set's folder; all shards but the last one are full."""

    format: ClassVar[str] = "jbrep data set"
    format_version: ClassVar[int] = 4
    indent: ClassVar[int] = 1

    settings: DataSettings
    versions: Mapping[Version, Version]  # of the packages that made it
    commits: Commits = {}
    shards: tuple[Entry, ...] = ()

    @property
    def task(self) -> Task:
        """The task whose features the observations hold."""
        return self.settings.task

    @property
    def rows(self) -> int:
        """How many there are."""
        return sum(entry.rows for entry in self.shards)

    @property
    def episodes(self) -> int:
        """How many there are."""
        return sum(entry.episodes for entry in self.shards)

    @property
    def bytes(self) -> int:
        """Of all shards."""
        return sum(entry.bytes for entry in self.shards)

    @property
    def complete(self) -> bool:
        """Whether there are as many rows as the settings ask for."""
        return self.rows >= self.settings.steps

    def as_json(self) -> dict[str, Any]:
        """What its file has, with a hash of all that it says."""
        plain = super().as_json()
        return {**plain, _HASH: _digest(plain)}

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


def _digest(plain: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()


def new_manifest(settings: DataSettings, source: Manifest | None = None) -> Manifest:
    """A manifest without shards, of the installed versions of jbrep's and the environment's.

    Data derived from a source have the environment's versions from there: it need not be here.
    """
    from importlib.metadata import version  # slow to import, and readers don't need it

    from jbrep.envs.names import environment_versions

    versions = {name: version(name) for name in _PACKAGES}
    if source:
        versions = {**source.versions, **versions}
    elif not settings.is_imported:  # or else they come from an environment that may not be here
        versions |= environment_versions(settings.task)
    return Manifest(settings=settings, versions=versions, commits=dict(commits()))


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a data set."""
    path = folder / MANIFEST
    if not exists(path):
        raise InputError(
            f"no data set in {folder}: expected a folder with {MANIFEST}, as jbrep collect and "
            "jbrep data import write it"
        )
    given = parse_json(read_file(path), path, Manifest.format)
    stated = given.pop(_HASH, None)
    manifest = document_from(given, path, Manifest)
    if stated != _digest(given):
        raise DamageError(f"{path} is damaged: {AGAIN}")
    return manifest


def shard_path(folder: Path, shard: int) -> Path:
    """The file of a shard."""
    return folder / f"shard-{shard:05d}.h5"


def check_sizes(folder: Path, manifest: Manifest) -> None:
    """Make sure that all shards are there, by their sizes."""
    for shard, entry in enumerate(manifest.shards):
        _check_size(shard_path(folder, shard), entry)


def _check_size(path: Path, entry: Entry) -> None:
    if not exists(path):
        raise DamageError(f"{path} is missing: {AGAIN}")
    if (size := path.stat().st_size) != entry.bytes:
        raise DamageError(
            f"{path} is damaged: it has {size:,} bytes instead of {entry.bytes:,}; {AGAIN}"
        )


def open_shard(folder: Path, manifest: Manifest, shard: int, *, known: bool = False) -> Columns:
    """The columns of a shard, as read-only views of its file, unless that is damaged.

    Its size is always checked, its hash unless it is `known` to be right.
    """
    path, entry = shard_path(folder, shard), manifest.shards[shard]
    _check_size(path, entry)
    with refusing(f"can't read {path}", (OSError,)), path.open("rb") as file:
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    if not known and hashlib.sha256(content).hexdigest() != entry.sha256:
        raise DamageError(f"{path} is damaged: its SHA-256 isn't the manifest's; {AGAIN}")
    columns = dict[str, NDArray[Any]]()
    errors = (LookupError, OverflowError, TypeError, ValueError)
    with refusing(f"{path} is damaged: a column isn't in it", errors, kind=DamageError):
        for name, spec in manifest.settings.specs().items():
            shape = (entry.episodes if name.startswith(EPISODES) else entry.rows, *spec.row)
            columns[name] = np.ndarray(shape, spec.dtype, content, entry.offsets[name])
    lengths = columns[EPISODES + "length"]
    if (lengths < 1).any() or lengths.sum() != entry.rows:
        raise DamageError(f"{path} is damaged: its episodes aren't as long as it has rows; {AGAIN}")
    return columns


def shard_image(manifest: Manifest, shard: int, columns: Columns) -> tuple[Entry, bytes]:
    """What the manifest says of a shard, and the bytes of its file: equal ones of equal columns."""
    import h5py  # slow to import, and readers don't need it

    rows, episodes = len(columns["step"]), len(columns[EPISODES + "length"])
    with h5py.File.in_memory() as file:
        file.attrs.update(manifest.attributes(shard, rows))
        made = {name: file.create_dataset(name, data=values) for name, values in columns.items()}
        file.flush()
        image: bytes = file.id.get_file_image()
        offsets = {name: each.id.get_offset() for name, each in made.items()}
    digest = hashlib.sha256(image).hexdigest()
    entry = Entry(bytes=len(image), rows=rows, episodes=episodes, sha256=digest, offsets=offsets)
    return entry, image


def commit(folder: Path, manifest: Manifest, columns: Columns) -> Manifest:
    """Write the next shard, then the manifest that lists it, which is returned."""
    path = shard_path(folder, len(manifest.shards))
    entry, image = shard_image(manifest, len(manifest.shards), columns)
    grown = manifest.replace(shards=(*manifest.shards, entry))

    def ready() -> None:
        if exists(path):  # the same shard with fewer episodes, which counted until now
            manifest.write(folder / MANIFEST)

    write_whole(path, image, ready)
    grown.write(folder / MANIFEST)
    return grown


def find_problems(folder: Path) -> Iterator[str]:
    """A line for each file of a data set that is damaged or missing."""
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
            continue
        if not manifest.settings.is_imported:  # which tells of its own
            problems = range_problems(manifest.settings.task, columns)
            yield from (f"{shard_path(folder, shard)}: {each}" for each in problems)


def policy_files(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    """The files of the trained policies that acted in a data set, by name, as they were then."""
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
        if not np.float32(low) <= values.min() <= values.max() <= np.float32(high):
            extent = f"ranges from {values.min():g} to {values.max():g}"
            yield f"{name} {extent}, beyond [{low:g}, {high:g}]"
