"""Every stage on environments of four makers, and how fast they are collected.

python benchmarks/environments.py [FOLDER]; needs jbrep[learn,suite,view], and panda-gym for the
third party's robot, on PyBullet (left out with a note where it isn't installed). For each: 200,000
states on all cores, verified with replay; dae and pca at half of the features; their evaluation; a
study of the full observation and the two with SAC at toy length, its report, and a recording. Then
a table: states a second to disk, against a plain loop over the environment in one process.
"""

import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium
import numpy as np

from jbrep.dataset import Dataset
from jbrep.envs import Task
from jbrep.envs.make import make_env
from jbrep.envs.names import import_modules
from jbrep.text import table

TASKS = ("Pendulum-v1", "Hopper-v5", "dm_control/cheetah-run-v0", "PandaReach-v3")
MODULES = {"PandaReach-v3": "panda_gym"}
STEPS = 200_000
LOOP_SECONDS = 5.0

STUDY = """
tasks = ["{task}"]
algorithms = ["sac-modern"]
representations = ["full", "dae-{latent}", "pca-{latent}"]
seeds = 2
steps = 1500
evaluate_every = 750
evaluation_episodes = 2

[data]
folder = "{data}"

[training]
epochs = 3
"""


def jbrep(*words: object, module: str | None = None) -> None:
    """Run a command as a user would, and show it."""
    command = [*map(str, words), *(["--import", module] if module else [])]
    print(f"\n$ jbrep {' '.join(command)}", flush=True)
    subprocess.run([sys.executable, "-m", "jbrep", *command], check=True)


def loop_rate(task: Task) -> float:
    """States a second of a plain loop with random actions."""
    env = make_env(task.id, task.arguments, task.max_episode_steps)
    space = env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    random = np.random.default_rng(0)
    env.reset(seed=0)
    steps, began = 0, time.perf_counter()
    while time.perf_counter() - began < LOOP_SECONDS:
        action = random.uniform(space.low, space.high).astype(space.dtype)
        _, _, terminated, truncated, _ = env.step(action)
        steps += 1
        if terminated or truncated:
            env.reset(seed=steps)
    env.close()
    return steps / (time.perf_counter() - began)


def walk_through(name: str, folder: Path) -> tuple[str, ...]:
    """Every stage on a task; a row of the table."""
    module = MODULES.get(name)
    data, encoders = folder / "data", folder / "encoders"
    began = time.perf_counter()
    jbrep("collect", "--task", name, "--steps", STEPS, "--out", data, module=module)
    rate = STEPS / (time.perf_counter() - began)
    task = Dataset(data).task
    loop = loop_rate(task)
    jbrep("data", "verify", data, "--replay", 20, module=module)
    latent = task.size // 2
    jbrep("train-dae", "--data", data, "--latent", latent, "--epochs", 5, "--out", encoders)
    jbrep("train-encoder", "--kind", "pca", "--data", data, "--latent", latent, "--out", encoders)
    files = [encoders / f"{kind}-{latent}.safetensors" for kind in ("dae", "pca")]
    jbrep("evaluate", "--data", data, "--encoder", *files, "--out", folder / "evaluation")
    study = folder / "study.toml"
    study.write_text(STUDY.format(task=name, latent=latent, data=data))
    jbrep("study", study, "--out", folder / "study", module=module)
    jbrep("report", folder / "study")
    recording = folder / "episode.rrd"
    jbrep("inspect", data, "--encoder", files[0], "--out", recording, module=module)
    return (
        name,
        f"{task.size}",
        f"{task.action_size}",
        f"{rate:,.0f}",
        f"{loop:,.0f}",
        f"{rate / loop:.2f}",
    )


def main(folder: Path) -> None:
    rows = []
    for name in TASKS:
        module = MODULES.get(name)
        if module and not find_spec(module):
            print(f"\n{name} is left out: pip install {module.replace('_', '-')}")
            continue
        if module:
            import_modules([module])
        rows.append(walk_through(name, folder / name.replace("/", "-")))
    header = ("task", "features", "actions", "collected/s", "plain loop/s", "ratio")
    print(f"\n{table(header, rows)}")


if __name__ == "__main__":
    with TemporaryDirectory() as temporary:
        main(Path(*sys.argv[1:2] or [temporary]))
