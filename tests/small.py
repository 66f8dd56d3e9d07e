"""Small data sets, and shards without the wait for physics."""

from jbrep.collect import write_shards
from jbrep.dataset import Settings
from jbrep.dataset.manifest import open_shard, read_manifest
from jbrep.envs import describe


def settings(**changes):
    small = {
        "task": "face_direction",
        "policy": {"kind": "uniform"},
        "steps": 5000,
        "seed": 3,
        "shard_episodes": 1,
        "store_state": True,
    }
    return Settings(**{**small, **changes})


def brief(**changes):
    """Five episodes of 100 steps, each in a shard."""
    task = describe(changes.pop("task", "face_direction"), max_episode_steps=100)
    return settings(**{"task": task, "steps": 500, **changes})


def write_again(source, folder):
    """Commit the shards of a data set to another folder, as a collector would."""
    manifest = read_manifest(source)

    def produce(first, missing, tick):
        for shard in range(first, len(manifest.shards)):
            yield open_shard(source, manifest, shard)

    return write_shards(manifest.settings, folder, produce).manifest


def contents(folder):
    """The bytes of all files that belong to a data set."""
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}
