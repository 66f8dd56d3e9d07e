"""Collecting and reading, side by side with what a user would do instead.

python benchmarks/dataset.py; ratios are medians over rounds taken in turn, so that a machine that
slows down slows both sides.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mujoco.batch import Batch
from rows import make_rows
from timing import show, timed

from jbrep import jitterbug
from jbrep.collecting import collect
from jbrep.dataset import Dataset, DataSettings
from jbrep.envs import describe
from jbrep.jitterbug.simulation import PHYSICS_STEPS, fast_model, stop_profiling
from jbrep.jitterbug.tasks import EPISODE_STEPS, TASKS

TASK = "face_direction"
NUM_ENVS = 50
ROWS = 5_000_000
BATCH = 8192
ROUNDS = 6

COLD = f"""
import numpy as np
rows = np.random.default_rng(0).integers({ROWS}, size={BATCH})
"""
COLD_JBREP = """
from jbrep.dataset import Dataset
Dataset({folder!r})["observation"][rows]
"""
COLD_MEMMAP = """
np.memmap({flat!r}, np.float32, mode="r").reshape(-1, 16)[rows]
"""


@cache  # its process makes it once
def dm_control_file(folder: Path) -> tuple[Any, h5py.File]:
    environment = jitterbug.load(TASK, seed=0)
    file = h5py.File(folder / "loop.h5", "w")
    for name, width in (("observation", TASKS[TASK].plain.size), ("action", 1), ("reward", 1)):
        file.create_dataset(name, (0, width), "f4", maxshape=(None, width), chunks=(1000, width))
    return environment, file


def dm_control_loop(folder: Path) -> float:
    """Control steps per second of one episode in a loop that appends it to an HDF5 file."""
    environment, file = dm_control_file(folder)
    random = np.random.default_rng(0)

    def episode() -> None:
        rows: dict[str, list[Any]] = {"observation": [], "action": [], "reward": []}
        now = environment.reset()
        while not now.last():
            action = random.uniform(-1, 1, 1)
            rows["observation"].append(np.concatenate(list(now.observation.values())))
            now = environment.step(action)
            rows["action"].append(action)
            rows["reward"].append([now.reward])
        for name, values in rows.items():
            file[name].resize(len(file[name]) + len(values), axis=0)
            file[name][-len(values) :] = values
        file.flush()

    return EPISODE_STEPS / timed(episode)


def collected_rate(folder: Path) -> float:
    """Control steps per second of collecting a shard to the disk."""
    settings = DataSettings(
        task=describe(TASK), steps=NUM_ENVS * EPISODE_STEPS, shard_episodes=NUM_ENVS
    )

    return settings.steps / timed(lambda: collect(settings, folder, NUM_ENVS))


def bare_rate() -> float:
    """Control steps per second of the same physics and nothing else."""
    batch = Batch(fast_model(), NUM_ENVS, 0)
    control = batch.bind("ctrl")
    random = np.random.default_rng(0)

    def episodes() -> None:
        batch.reset()
        for _ in range(EPISODE_STEPS):
            control[:] = random.uniform(-1, 1, (NUM_ENVS, 1))
            batch.step(nstep=PHYSICS_STEPS)

    return NUM_ENVS * EPISODE_STEPS / timed(episodes)


def compare_collectors(folder: Path) -> None:
    stop_profiling()
    rates: dict[str, list[float]] = {"jbrep": [], "bare": [], "loop": []}
    with ProcessPoolExecutor(1, get_context("spawn")) as elsewhere:  # it keeps MuJoCo's clock
        for k in range(ROUNDS):
            rates["loop"].append(elsewhere.submit(dm_control_loop, folder).result())
            rates["jbrep"].append(collected_rate(folder / f"collected-{k}"))
            rates["bare"].append(bare_rate())
    for name, values in rates.items():
        print(f"{name:8} {np.median(values):10,.0f} control steps/s")
    ours = np.array(rates["jbrep"])
    show("collector to disk / bare batched physics", ours / rates["bare"], ">= 0.95")
    loop = "collector to disk / dm_control loop that appends to HDF5"
    show(loop, ours / rates["loop"], ">= 2.8")


def memory_of(steps: int, folder: Path) -> float:
    """The collector's peak of resident memory [MB]."""
    code = (
        "import re, sys; from jbrep.cli import main\n"
        "main(sys.argv[1:], standalone_mode=False)\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
    )
    arguments = ["collect", "--task", TASK, "--steps", str(steps), "--out", str(folder)]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    return int(done.stdout.split()[-1]) / 1000


def copy_through(blocks: Iterator[Any], size: int) -> None:
    buffer = np.empty((BATCH, size), np.float32)
    for block in blocks:
        buffer[: len(block)] = block


def compare_readers(folder: Path) -> None:
    random = np.random.default_rng(0)
    data = make_rows(folder / "rows", TASK, ROWS, lambda _, shape: random.integers(0, 100, shape))
    flat, size = folder / "flat", data.task.size
    np.asarray(data["observation"]).tofile(flat)
    codes = {
        "python and numpy alone": COLD,
        "jbrep": COLD + COLD_JBREP.format(folder=str(data.folder)),
        "np.memmap of one flat file, unchecked": COLD + COLD_MEMMAP.format(flat=str(flat)),
    }
    seconds: dict[str, list[float]] = {name: [] for name in codes}
    for _ in range(2 * ROUNDS):
        for name, code in codes.items():
            run = [sys.executable, "-c", code]
            seconds[name].append(timed(partial(subprocess.run, run, check=True)))
    for name, values in seconds.items():
        print(f"cold process to a first random batch: {name:40} {np.median(values):.3f} s")
    print("  aim: < 0.5 s; jbrep checks the hash of every shard in that time", flush=True)

    def flat_rows() -> Any:
        return np.memmap(flat, np.float32, mode="r").reshape(-1, size)

    def plain_pass(rows: Any) -> float:
        starts = range(0, ROWS, BATCH)
        return timed(lambda: copy_through((rows[s : s + BATCH] for s in starts), size))

    def our_pass(opened: Dataset) -> float:
        return timed(lambda: copy_through(opened["observation"].chunks(BATCH), size))

    first, later = [], []
    for _ in range(ROUNDS):
        opened = Dataset(data.folder)
        plain = flat_rows()
        first.append(plain_pass(plain) / our_pass(opened))
        later.append(plain_pass(plain) / our_pass(opened))
    show("first sequential pass, which checks / np.memmap", first)
    show("sequential pass / np.memmap", later, ">= 0.9")


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        compare_readers(folder)
        compare_collectors(folder)
        for steps in (100_000, 400_000):
            peak = memory_of(steps, folder / f"memory-{steps}")
            print(f"collector's peak memory, {steps:,} steps: {peak:.0f} MB   aim: < 500 MB")


if __name__ == "__main__":
    main()
