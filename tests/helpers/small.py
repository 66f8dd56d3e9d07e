"""Small data sets, and shards without the wait for physics."""

import hashlib
import json

from jbrep.collecting import write_shards
from jbrep.collecting.derive import _each_shard
from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import read_manifest
from jbrep.envs import describe
from jbrep.rl import Session

ONE_EACH = {"evaluation_episodes": 1, "final_episodes": 1}  # of a run, in each of its evaluations


def settings(task="face_direction", **changes):
    small = {
        "task": describe(task) if isinstance(task, str) else task,
        "policy": {"kind": "uniform"},
        "steps": 5000,
        "seed": 3,
        "shard_episodes": 1,
        "store_state": True,
    }
    return DataSettings(**{**small, **changes})


def brief(task="face_direction", **changes):
    """Five episodes of 100 steps, each in a shard."""
    return settings(describe(task, episode_steps=100), **{"steps": 500, **changes})


def assert_same_files(one, other, *names):
    """Files of two folders have the same bytes."""
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


def write_again(source, folder, change=lambda columns: columns):
    """Write the shards of a data set to another folder, as a collector would, or changed ones."""
    dataset = Dataset(source)
    write_shards(dataset.manifest.settings, folder, _each_shard(dataset, change))
    return read_manifest(folder)


def flip_bit(path, bit):
    """Change a bit of a file."""
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def stopping(step):
    """A session of training that ends after so many steps."""
    steps = [0]
    return Session(lambda _, now: steps.append(now), stop=lambda: steps[-1] >= step)


def forge(path, record):
    """Write a document of whatever it says."""
    path.write_text(json.dumps(record))


def adopt(document, *names):
    """Forge the checksums of tables that were changed, in the document beside them."""
    record = json.loads(document.read_text())
    for name in names:
        content = (document.parent / name).read_bytes()
        record["tables"][name] = hashlib.sha256(content).hexdigest()
    forge(document, record)


def contents(folder):
    """The bytes of all files in a data set's folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def written(folder, write):
    """The numbers of the shards in a folder that a call writes, or writes again."""

    def stamps():
        files = {path: path.stat() for path in folder.glob("*.h5")}
        return {path: (each.st_ino, each.st_mtime_ns) for path, each in files.items()}

    before = stamps()
    write()
    changed = [path for path, stamp in stamps().items() if before.get(path) != stamp]
    return sorted(int(path.stem.removeprefix("shard-")) for path in changed)
