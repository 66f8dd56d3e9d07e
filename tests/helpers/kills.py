"""Kill a collector at random times and let it go on: python tests/helpers/kills.py 200."""

import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from small import contents, settings

from jbrep.collecting import collect
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST, read_manifest
from jbrep.envs import describe

STEPS = 500  # of each episode
TASK = describe("face_direction", episode_steps=STEPS)
SETTINGS = settings(task=TASK, steps=4_000, store_state=False)
COMMAND = [
    *(sys.executable, "-c", "from jbrep.cli import main; main()", "collect"),
    *("--task", "face_direction", "--seed", "3", "--shard-episodes", "1", "--num-envs", "1"),
    *("--episode-steps", str(STEPS)),
]


@dataclass
class Tally:
    kills: int = 0
    ends: int = 0  # data sets that came to their end and equal the uninterrupted one
    committed: int = 0  # shards found unchanged after a kill


def kill_and_resume(kills: int, folder: Path, seed: int) -> Tally:
    """Kill so many times; each data set must end equal to one collected in peace."""
    random = np.random.default_rng(seed)
    collect(SETTINGS, folder / "peace")
    peace = contents(folder / "peace")
    tally = Tally()
    while tally.kills < kills or not tally.ends:
        data = folder / f"data-{tally.ends}"
        while not _run(data, random.uniform(0.1, 2) if tally.kills < kills else None):
            tally.kills += 1
            tally.committed += _check_prefix(data, peace)
        assert contents(data) == peace
        tally.ends += 1
    return tally


def _run(data: Path, seconds: float | None) -> bool:
    """Collect; kill it so long after it began its work. Whether it came to its end first."""
    steps = ("--steps", str(SETTINGS.steps), "--out", str(data))
    lock = data / ".lock"
    before = lock.stat().st_mtime_ns if lock.exists() else 0
    told = data.with_suffix(".told")
    with told.open("w") as stderr:
        process = subprocess.Popen([*COMMAND, *steps], stdout=subprocess.DEVNULL, stderr=stderr)
        while process.poll() is None and not (lock.exists() and lock.stat().st_mtime_ns > before):
            time.sleep(0.02)
        try:
            assert process.wait(seconds) == 0, told.read_text()[-1000:]
            return True
        except subprocess.TimeoutExpired:
            process.kill()
            assert process.wait() == -signal.SIGKILL
            return False


def _check_prefix(data: Path, peace: dict[str, bytes]) -> int:
    """What the manifest names is there, as it is in peace; at most the open shard is lost."""
    if not (data / MANIFEST).exists():
        return 0
    now, shards = contents(data), len(read_manifest(data).shards)
    for shard in range(shards):
        name = f"shard-{shard:05d}.h5"
        assert now[name] == peace[name], name
    others = {name for name in now if name.endswith(".h5")}
    assert len(others) <= shards + 1
    assert len(Dataset(data)["observation"][:]) == STEPS * shards
    return shards


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        print(kill_and_resume(int(sys.argv[1]), Path(temporary), seed=1))
