"""The collector: a policy in many episodes, written to the shards of a data set."""

from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from jbrep.collecting.backends import local
from jbrep.collecting.policies import Policy, make_policy
from jbrep.collecting.replay import replay_problems
from jbrep.collecting.shards import NUM_ENVS, Growth, Produce, Simulator
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import (
    MANIFEST,
    Manifest,
    check_sizes,
    new_manifest,
    read_manifest,
    shard_path,
)
from jbrep.dataset.schema import EPISODES, DataSettings
from jbrep.dataset.settings import MOST_SHARDS, SHARD_ROWS
from jbrep.envs.environments import check_counts
from jbrep.envs.make import is_batched
from jbrep.errors import DamageError, InputError, differences
from jbrep.progress import Progress
from jbrep.records.storage import check_space, exclusive, exists, make_folder, write_whole
from jbrep.text import counted

_BATCH_ROWS = 100_000  # of a shard that a batch makes
_PILOT = 10  # episodes


def collect(
    settings: DataSettings,
    folder: Path,
    num_envs: int = NUM_ENVS,
    num_threads: int | None = None,
    policy: Policy | None = None,
    retries: int = 0,
) -> Manifest:
    """Collect a data set, or what is missing of it; `jbrep.collect` says what its arguments are.

    The bytes depend neither on the number of environments or threads, nor on whether a data set is
    collected at once or extended. Before one that is there is continued, an episode of it is played
    again: it must be the same to the last bit, where the environment is reproducible.
    """
    policy = policy or make_policy(settings.policy)
    policy.begin(settings.task, [0])  # may refuse the task
    settings = settings.replace(policy=policy.settings())
    check_counts(num_envs, num_threads)
    simulator = Simulator(settings, policy, num_envs, num_threads, retries)
    produce = local(simulator)

    def check(wanted: Manifest) -> None:
        """Play an episode of the data set again before it is continued."""
        if wanted.complete or not settings.task.reproducible:
            return
        if any(replay_problems(Dataset(folder), 1, num_threads)):
            raise InputError(
                f"{folder} can't be continued: an episode of {settings.task.name} comes out "
                "differently when it is played again; has the environment changed, or is this "
                "another machine? Choose another folder for other data"
            )

    return write_shards(settings, folder, produce, policy.files(), check)


def write_shards(
    settings: DataSettings,
    folder: Path,
    produce: Produce,
    files: Mapping[str, bytes] = MappingProxyType({}),
    check: Callable[[Manifest], None] = lambda wanted: None,
    source: Manifest | None = None,
) -> Manifest:
    """Write the missing shards, until there are as many rows as the settings ask for.

    Args:
        produce: makes the episodes.
        files: that the data set needs besides, by name.
        check: called with the manifest of what is wanted, where episodes are there already: whether
            they may stay, and others be added to them.
        source: of the data that these are derived from, see `new_manifest`.
    """
    make_folder(folder, ("manifest*", "shard-*", "policy-*"))
    with exclusive(folder):
        there = _begin(new_manifest(settings, source), folder, files)
        wanted = there.replace(settings=there.settings.replace(steps=settings.steps))
        if there.shards:
            check(wanted)
        if not wanted.complete:
            return _fill(Growth(folder, wanted), produce, folder.name, there)
        if wanted != there:
            wanted.write(folder / MANIFEST)
    return wanted


def _fill(growth: Growth, produce: Produce, name: str, there: Manifest) -> Manifest:
    begun, total = growth.rows, growth.manifest.settings.steps
    options: dict[str, Any] = {"unit": "step", "unit_scale": True, "desc": name}
    with Progress(total=total, initial=begun, **options) as progress:
        pieces = produce(growth, progress.update)
        try:
            while growth.lacking > 0:
                growth.add(next(pieces))
        except DamageError:
            raise
        except InputError as error:
            kept = max(there, growth.manifest, key=lambda manifest: manifest.rows)
            if not kept.shards:
                raise
            episodes = counted(kept.episodes, "episode")
            raise InputError(f"{error}; {episodes} of {kept.rows:,} rows are kept") from None
        finally:
            if isinstance(pieces, Generator):
                pieces.close()
    return growth.manifest


def _begin(wanted: Manifest, folder: Path, files: Mapping[str, bytes]) -> Manifest:
    """The manifest to go on from: what is there, or what is wanted, without shards."""
    settings, there = wanted.settings, wanted
    begun = read_manifest(folder) if exists(folder / MANIFEST) else None
    if begun and begun.shards:
        there = begun
        _check_same(there, wanted, folder)
        check_sizes(folder, there)
    elif begun is None and exists(shard_path(folder, 0)):
        raise InputError(f"{folder} has shards but no {MANIFEST}: choose another folder")
    check_space(folder, (settings.steps - there.rows) * settings.row_bytes())
    for name, content in files.items():
        if there is wanted or not exists(folder / name):
            write_whole(folder / name, content)
        elif (folder / name).read_bytes() != content:
            raise InputError(f"{folder / name} is another policy's file: choose another folder")
    if there is wanted:
        wanted.write(folder / MANIFEST)
    return there


def _check_same(there: Manifest, wanted: Manifest, folder: Path) -> None:
    steps, own = wanted.settings.steps, there.settings.steps
    before, now = _plain(there.settings), _plain(wanted.settings)
    if before != {**now, "steps": own}:
        raise InputError(
            f"{folder} holds a data set with other settings: {differences(before, now)}; "
            "choose another folder, or the same settings to resume"
        )
    if steps < own:
        raise InputError(
            f"{folder} was collected with {own:,} steps: ask for at least as many, or choose "
            f"another folder for {steps:,}"
        )
    differing = differences(there.versions, wanted.versions)
    if differing and not (there.complete and steps == own):
        raise InputError(
            f"{folder} was started with other versions: {differing}; "
            "install those to go on, or choose another folder"
        )


def _plain(settings: DataSettings) -> dict[str, Any]:
    """The settings without whether episodes terminate, which is what was seen of some."""
    plain = settings.as_json()
    return plain | {"environment": {**plain["environment"], "terminates": None}}


def usual_shard_episodes(
    settings: DataSettings, folder: Path, policy: Policy, retries: int = 0
) -> int:
    """Episodes in a shard of the usual size, judging by the data set's first few.

    A data set that is there already keeps its own number. Where no episode can be played again, a
    robot may exist once: none is played for this, and each is written when it is over.
    """
    if exists(folder / MANIFEST):
        return read_manifest(folder).settings.shard_episodes
    task = settings.task
    length = float(task.max_episode_steps)
    if not task.reproducible:
        return max(1, round(settings.steps / length / MOST_SHARDS))
    if task.terminates is not False:
        simulator = Simulator(settings, policy, retries=retries)
        played = simulator.made(range(_PILOT), lambda steps: None)
        length = np.mean([steps for each in played for steps in each[EPISODES + "length"]])
    return max(1, round((_BATCH_ROWS if is_batched(task) else SHARD_ROWS) / length))
