"""Repairing a data set: damaged or missing shards are made again as they were."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from jbrep.collect.policies import Policy, make_policy
from jbrep.collect.replay import why_not_again, why_otherwise
from jbrep.collect.shards import LANES, Simulator
from jbrep.dataset.manifest import Manifest, open_shard, read_manifest, shard_image, shard_path
from jbrep.dataset.schema import joined
from jbrep.dataset.verify import policy_files
from jbrep.envs.lanes import check_counts
from jbrep.errors import DamageError, InputError
from jbrep.progress import Progress
from jbrep.records.lock import exclusive
from jbrep.records.storage import write_whole


def repair(
    folder: Path,
    lanes: int = LANES,
    num_threads: int | None = None,
    make: Callable[[Mapping[str, Any]], Policy] = make_policy,
) -> Iterator[str]:
    """Make damaged and missing shards again from their seeds; yields a line for each.

    Args:
        folder: of the data set.
        lanes: environments of a batch.
        num_threads: of a batch; None takes one for each core.
        make: makes the policy from what the manifest says of it.
    """
    check_counts(lanes, num_threads)
    read_manifest(folder)  # so that nothing is locked that isn't a data set
    with exclusive(folder):
        manifest = read_manifest(folder)
        settings = manifest.settings
        for shard in range(len(manifest.shards)):
            try:
                open_shard(folder, manifest, shard)
            except DamageError:
                path = shard_path(folder, shard)
                reason = why_not_again(settings)
                if settings.reward:
                    reason = f"{settings.reward} gave the rewards; derive them again elsewhere"
                if reason:
                    raise InputError(f"{path} can't be restored: {reason}") from None
                simulator = Simulator(settings, make(settings.policy), lanes, num_threads)
                write_whole(path, _image(simulator, manifest, shard, path))
                yield f"{path} restored"
        policy_files(folder, manifest)


def _image(simulator: Simulator, manifest: Manifest, shard: int, path: Path) -> bytes:
    """The bytes of a shard, simulated again."""
    entry, task = manifest.shards[shard], manifest.task
    first = shard * manifest.settings.shard_episodes
    with Progress(total=entry.rows, unit="step", unit_scale=True, desc=path.name) as progress:
        try:
            episodes = range(first, first + entry.episodes)
            blocks = [*simulator.made(episodes, progress.update)]
        except InputError as error:
            again = "; derive the data set again in another folder" if task.view else ""
            raise InputError(f"{path} can't be restored: {error}{again}") from None
    made, image = shard_image(manifest, shard, joined(blocks))
    if made != entry:
        why = why_otherwise(manifest)
        raise InputError(f"{path} can't be restored here: it comes out differently; {why}")
    return image
