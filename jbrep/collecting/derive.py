"""Deriving data sets from the same motion: with other rewards, or less or more to see."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from msgspec import UNSET

from jbrep.collecting.collector import write_shards
from jbrep.collecting.shards import Growth, Produce
from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import Manifest, new_manifest, open_shard, policy_files, shard_image
from jbrep.dataset.rewards import reward_function, without_range
from jbrep.dataset.schema import EPISODES, Columns, some_episodes
from jbrep.envs.names import with_digest
from jbrep.envs.recording import Tick
from jbrep.envs.task import Task
from jbrep.envs.view import seen_in_episodes, with_view
from jbrep.errors import InputError, differences


def derive(
    source: Path, folder: Path, hidden: Sequence[str] = (), history: int = 1, reward: str = ""
) -> Manifest:
    """Write a data set of any robot with less or more to see, or with other rewards.

    What is hidden, and the history, are as `with_view` takes them; the reward, as `reward_function`
    does, is of what the source shows. An unfinished derivation is resumed.
    """
    dataset = Dataset(source)
    if not dataset.manifest.complete:
        raise InputError(f"{source} is unfinished: resume it with the same jbrep collect")
    settings = dataset.manifest.settings
    changes = list[Callable[[Columns], Columns]]()
    if reward:
        task = without_range(settings.task)
        named = with_digest(reward, "reward")
        settings = settings.replace(task=task, reward=named, unrewarded=UNSET)
        changes.append(_rewarded(reward))
    if hidden or history > 1:
        settings = settings.replace(task=with_view(settings.task, hidden, history))
        changes.append(_seen(settings.task))
    _check_versions(dataset, settings)

    def changed(columns: Columns) -> Columns:
        for change in changes:
            columns = change(columns)
        return settings.columns(columns)

    def check(wanted: Manifest) -> None:
        _check_derived(folder, wanted, dataset, changed)

    files, produce = policy_files(source, dataset.manifest), _each_shard(dataset, changed)
    return write_shards(settings, folder, produce, files, check, dataset.manifest)


def _check_derived(
    folder: Path, wanted: Manifest, dataset: Dataset, change: Callable[[Columns], Columns]
) -> None:
    """Check that the shards of a folder are what comes of these data.

    Settings alone don't say so: they are the same of a log that was imported once more.
    """
    known, is_same = dataset.manifest, len(wanted.shards) <= len(dataset.manifest.shards)
    for shard, entry in enumerate(wanted.shards if is_same else ()):
        columns = change(open_shard(dataset.folder, known, shard))
        made, _ = shard_image(wanted, shard, some_episodes(columns, 0, entry.episodes))
        is_same = is_same and made == entry
    if not is_same:
        raise InputError(
            f"{folder} was derived from other data than {dataset.folder}: choose another folder"
        )


def _rewarded(code: str) -> Callable[[Columns], Columns]:
    rewards = reward_function(code)

    def change(columns: Columns) -> Columns:
        ends = np.cumsum(columns[EPISODES + "length"])[:-1]
        parts = (np.split(columns[name], ends) for name in ("observation", "action"))
        given = [rewards(*episode) for episode in zip(*parts, strict=True)]
        return {**columns, "reward": np.concatenate(given).astype(np.float32)}

    return change


def _seen(task: Task) -> Callable[[Columns], Columns]:
    final = EPISODES + "final_observation"
    given = "observation", "action", final, EPISODES + "length"

    def change(columns: Columns) -> Columns:
        before, last = seen_in_episodes(task, *(columns[name][:] for name in given))
        return {**columns, "observation": before, final: last}

    return change


def _check_versions(dataset: Dataset, settings: DataSettings) -> None:
    """Check that MuJoCo, NumPy and h5py are those that made a data set; jbrep may be another."""
    earlier = dataset.manifest.versions
    versions = new_manifest(settings, dataset.manifest).versions
    if differing := differences({**earlier, "jbrep": versions["jbrep"]}, versions):
        raise InputError(
            f"{dataset.folder} was collected with other versions: {differing}; a derived data set "
            "needs the same"
        )


def _each_shard(dataset: Dataset, change: Callable[[Columns], Columns]) -> Produce:
    def produce(growth: Growth, tick: Tick) -> Iterator[Columns]:
        manifest, each = dataset.manifest, dataset.manifest.settings.shard_episodes
        for shard in range(growth.episodes // each, len(manifest.shards)):
            columns = change(open_shard(dataset.folder, manifest, shard))
            known = growth.episodes - shard * each
            yield some_episodes(columns, known, manifest.shards[shard].episodes)

    return produce
