"""The collector: a policy in many episodes, written to the shards of a data set."""

import time
from collections.abc import Callable, Generator, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.backends import BACKENDS
from jbrep.collect.policies import Policy, make_policy
from jbrep.collect.replay import replay_problems
from jbrep.collect.shards import LANES, SHARD_ROWS, Produce, Remaining, Simulator
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import (
    MANIFEST,
    Manifest,
    check_files,
    commit,
    current_manifest,
    hdf5_files,
    new_manifest,
    read_manifest,
    write_manifest,
)
from jbrep.dataset.schema import EPISODES, Columns, DataSettings, joined, some_episodes
from jbrep.envs.lanes import check_counts
from jbrep.envs.make import is_batched
from jbrep.errors import DamageError, InputError, choose, differences
from jbrep.progress import Progress
from jbrep.records.lock import exclusive
from jbrep.records.record import to_plain
from jbrep.records.storage import check_space, exists, make_folder, read_file, write_whole
from jbrep.text import counted

_MAX_SHARDS = 10_000
_BATCH_ROWS = 100_000  # of a shard that a batch makes
_PILOT = 10  # episodes
_HOLD_SECONDS = 30.0  # that episodes of a shard that isn't full are held before they are written

_LENGTH = EPISODES + "length"

Array = NDArray[Any]


def collect(
    settings: DataSettings,
    folder: Path,
    lanes: int = LANES,
    num_threads: int | None = None,
    backend: str = "local",
    policy: Policy | None = None,
    retries: int = 0,
) -> Manifest:
    """Collect a data set, or what is missing of it.

    The bytes depend neither on lanes, threads or backend, nor on whether a data set is collected at
    once or extended. Before one that is there is continued, an episode of it is played again: it
    must be the same to the last bit, where the environment is reproducible.

    Args:
        settings: what to collect.
        folder: new, or with a data set of the same settings that is unfinished or has fewer steps.
        lanes: environments of a batch, stepped at once.
        num_threads: threads of a batch, or processes of other environments; None takes one for
            each core.
        backend: local, or ray for a cluster.
        policy: in place of the one that the settings name.
        retries: how often in a row an episode in which the environment fails is played again.
    """
    policy = policy or make_policy(settings.policy)
    policy.begin(settings.task, [0])  # may refuse the task
    settings = settings.replace(policy=policy.settings())
    check_counts(lanes, num_threads)
    simulator = Simulator(settings, policy, lanes, num_threads, retries)
    produce = choose(backend, BACKENDS, "backend")(simulator)

    def check(wanted: Manifest) -> None:
        if not wanted.complete:
            _check_environment(folder, num_threads)

    return write_shards(settings, folder, produce, policy.files(), check)


def _check_environment(folder: Path, num_threads: int | None) -> None:
    """Play an episode of a data set again."""
    dataset = Dataset(folder)
    if dataset.task.reproducible and any(replay_problems(dataset, 1, num_threads)):
        raise InputError(
            f"{folder} can't be continued: an episode of {dataset.task.name} comes out differently "
            "when it is played again; has the environment changed, or is this another machine? "
            "Choose another folder for other data"
        )


def write_shards(
    settings: DataSettings,
    folder: Path,
    produce: Produce,
    files: Mapping[str, bytes] = MappingProxyType({}),
    check: Callable[[Manifest], None] = lambda wanted: None,
    source: Manifest | None = None,
) -> Manifest:
    """Commit the missing shards, until there are as many rows as the settings ask for.

    Args:
        settings: of the data set.
        folder: of the data set.
        produce: makes shards, one after the other; of the last, only the episodes that are needed
            are kept.
        files: that the data set needs besides, by name.
        check: called with the manifest of what is wanted, where episodes are there already: whether
            they may stay, and others be added to them.
        source: of the data that these are derived from, see `new_manifest`.
    """
    make_folder(folder, ("manifest*", "shard-*", "policy-*"))
    with exclusive(folder):
        there = _begin(new_manifest(settings, source), folder, files)
        manifest = there.extended(settings.steps)
        if there.shards:
            check(manifest)
        if not manifest.complete:
            with Progress(
                total=settings.steps,
                initial=manifest.rows,
                unit="step",
                unit_scale=True,
                desc=folder.name,
            ) as progress:
                manifest = _fill(folder, there, manifest, produce, progress)
        elif manifest != there:
            write_manifest(folder, manifest)
    return manifest


def _fill(
    folder: Path, there: Manifest, manifest: Manifest, produce: Produce, progress: Any
) -> Manifest:
    """Commit episodes until the data set is complete: at the end of a shard, or after a while.

    Those that are finished are kept whatever ends this.
    """
    writing = _Writing(folder, there, Remaining(manifest))
    pieces = produce(manifest.full_shards, writing.remaining, progress.update)
    try:
        for columns in pieces:
            writing.add(columns)
            if writing.is_due:
                writing.commit(progress)
            if writing.remaining.rows <= 0:
                break
        writing.commit(progress)
    except BaseException as error:
        with suppress(InputError):  # a full disk
            writing.commit(progress)
        is_damage = isinstance(error, DamageError)
        if not isinstance(error, InputError) or is_damage or not writing.there.episodes:
            raise
        raise InputError(f"{error}; {writing.kept}") from None
    finally:
        if isinstance(pieces, Generator):
            pieces.close()
    return writing.remaining.manifest


class _Writing:
    """Episodes on their way into a data set.

    Args:
        folder: of the data set.
        there: its manifest so far, which counts until there is more.
        remaining: of the manifest that is wanted.

    Attributes:
        there: the manifest of what is written.
    """

    def __init__(self, folder: Path, there: Manifest, remaining: Remaining):
        self.remaining = remaining
        self._folder, self.there = folder, there
        self._held: list[Columns] = []
        self._committed = time.monotonic()

    def add(self, columns: Columns) -> None:
        """Hold the episodes that aren't there and are needed."""
        manifest = self.remaining.manifest
        first = manifest.episodes + sum(len(each[_LENGTH]) for each in self._held)
        if first // manifest.settings.shard_episodes >= _MAX_SHARDS:
            full = counted(manifest.settings.shard_episodes, "episode")
            raise InputError(
                f"{self._folder} has {_MAX_SHARDS:,} shards, which is the limit: put more than "
                f"{full} in a shard, in another folder"
            )
        known = first - int(columns[EPISODES + "episode"][0])
        ends = np.cumsum(columns[_LENGTH][known:])
        needed = int(np.searchsorted(ends, self.remaining.rows)) + 1
        self._held.append(some_episodes(columns, known, known + needed))
        self.remaining.held += len(self._held[-1]["step"])

    @property
    def is_due(self) -> bool:
        """Whether what is held fills a shard, is all that is needed, or has been held for long."""
        manifest = self.remaining.manifest
        episodes = manifest.episodes + sum(len(each[_LENGTH]) for each in self._held)
        return (
            episodes % manifest.settings.shard_episodes == 0
            or self.remaining.rows <= 0
            or time.monotonic() - self._committed > _HOLD_SECONDS
        )

    def commit(self, progress: Any) -> None:
        """Write what is held; it stays held until it is there."""
        if self._held:
            if self.remaining.manifest.settings != self.there.settings:
                write_manifest(self._folder, self.remaining.manifest)
            now = current_manifest(self._folder)  # one that was interrupted may have got through
            if now.episodes == self.remaining.manifest.episodes:
                now = commit(self._folder, self.remaining.manifest, joined(self._held))
            self.there = self.remaining.manifest = now
            self._held = []
            self.remaining.held, self._committed = 0, time.monotonic()
            progress.update(self.there.rows - progress.n)
            size = sum(entry.bytes for entry in self.there.shards)
            progress.set_postfix_str(f"{size / 1e6:,.0f} MB on disk", refresh=False)

    @property
    def kept(self) -> str:
        """What is there, for a message."""
        manifest = self.there
        return f"{counted(manifest.episodes, 'episode')} of {manifest.rows:,} rows are kept"


def _begin(wanted: Manifest, folder: Path, files: Mapping[str, bytes]) -> Manifest:
    """The manifest to go on from: what is there, or what is wanted, without shards."""
    settings, shards = wanted.settings, hdf5_files(folder)
    if (folder / MANIFEST).exists() or shards:
        manifest = current_manifest(folder)
        _check_same(manifest, wanted, folder)
        check_files(folder, manifest, shards)
        if manifest != read_manifest(folder):
            write_manifest(folder, manifest)
        _keep(files, folder)
        check_space(folder, (settings.steps - manifest.rows) * settings.row_bytes())
        return manifest
    check_space(folder, settings.steps * settings.row_bytes())
    _keep(files, folder)
    write_manifest(folder, wanted)
    return wanted


def _keep(files: Mapping[str, bytes], folder: Path) -> None:
    """Write files that aren't there."""
    for name, content in files.items():
        path = folder / name
        if not exists(path):
            write_whole(path, content)
        elif read_file(path) != content:
            raise InputError(f"{path} is another policy's file: choose another folder")


def _check_same(there: Manifest, wanted: Manifest, folder: Path) -> None:
    """Check that going on gives what an uninterrupted run gives."""
    steps, own = wanted.settings.steps, there.settings.steps
    differing = differences(_flat(there.settings), _flat(wanted.settings))
    if differing and _flat(there.settings) != {**_flat(wanted.settings), "steps": own}:
        raise InputError(
            f"{folder} holds a data set with other settings: {differing}; "
            "choose another folder, or the same settings to resume"
        )
    if steps < own:
        raise InputError(
            f"{folder} was collected with {own:,} steps and has {there.rows:,} rows so far: it is "
            f"left as it is; ask for at least as many steps, or choose another folder for {steps:,}"
        )
    differing = differences(there.versions, wanted.versions)
    if differing and not (there.complete and steps == own):
        raise InputError(
            f"{folder} was started with other versions: {differing}; "
            "install those to go on, or choose another folder"
        )


def _flat(settings: DataSettings) -> dict[str, Any]:
    """The settings with those of the environment beside them; equal names mean equal features.

    Whether it terminates is left out: it is what was seen of some episodes.
    """
    others = ("id", "name", "terminates")
    task = {n: v for n, v in to_plain(settings.task).items() if n not in others}
    return {n: v for n, v in settings.as_json().items() if n != "environment"} | task


def usual_shard_episodes(
    settings: DataSettings, folder: Path, policy: Policy | None = None, retries: int = 0
) -> int:
    """Episodes in a shard of the usual size, judging by the data set's first few.

    A batch's shards have 100,000 steps, each with all threads; other environments' 20,000, since
    they are made side by side. A data set that is there already keeps its own number. Where no
    episode can be played again, a robot may exist once: none is played for this.
    """
    if exists(folder / MANIFEST):
        return read_manifest(folder).settings.shard_episodes
    task = settings.task
    length = float(task.max_episode_steps)
    if task.terminates is not False and task.reproducible:
        policy = policy or make_policy(settings.policy)
        pilot = settings.replace(shard_episodes=_PILOT)
        columns = Simulator(pilot, policy, retries=retries).shard(0, lambda steps: None)
        length = columns[EPISODES + "length"].mean()
    return max(1, round((_BATCH_ROWS if is_batched(task) else SHARD_ROWS) / length))
