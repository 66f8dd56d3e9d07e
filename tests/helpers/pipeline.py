"""From states to a toy study, undisturbed or killed: python tests/helpers/pipeline.py 20."""

import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from command import in_this_process, jbrep, start, wait_for, wait_for_the_end_of, workers_of
from small import contents

from jbrep.reporting.report import MARKDOWN
from jbrep.studies.runner import BACKENDS
from jbrep.studies.tables import REFERENCE_RETURNS, RETURNS

STUDY = """
tasks = ["face_direction"]
algorithms = ["a2c-paper"]
representations = ["full", "dae-4"]
seeds = 2
steps = 80
evaluate_every = 80
evaluation_episodes = 1
final_episodes = 2
episode_steps = 100
data = {{folder = "{data}"}}
training = {{epochs = 30, batch_size = 25}}
"""
POINTS = {  # at which each stage may be killed: so many such files are there
    "collect": [("data/.lock", 1), ("data/shard-*.h5", 1), ("data/shard-*.h5", 2)],
    "train-dae": [("encoders/*.training", 1), ("encoders/*/checkpoint.safetensors", 1)],
    "study": [("study/study.json", 1), ("study/**/run.json", 1), ("study/**/run.json", 2)],
}
_LONGEST = 0.2  # seconds from there to the kill


def stages(folder):
    """The commands, each of which needs those before."""
    data, study = folder / "data", folder / "tiny.toml"
    study.write_text(STUDY.format(data=data))
    states = ("--task", "face_direction", "--episode-steps", 500, "--steps", "2k")
    states = (*states, "--shard-episodes", 1, "--num-envs", 1)
    training = ("--data", data, "--latent", 4, "--epochs", 30, "--batch-size", 25)
    return {
        "collect": ("collect", *states, "--out", data),
        "train-dae": ("train-dae", *training, "--out", folder / "encoders"),
        "study": ("study", study, "--workers", 2, "--out", folder / "study"),
    }


def in_peace(folder):
    """Run all, without workers."""
    folder.mkdir()
    for given in stages(folder).values():
        _run(given)


def _run(given):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BACKENDS, "local", in_this_process)
        done = jbrep(*given)
    assert done.exit_code == 0, done.output[-2000:]


def killed(folder, seed):
    """Kill each stage at a point that the seed draws, and start it again; where it was killed."""
    random, told = np.random.default_rng(seed), []
    folder.mkdir()
    for stage, given in stages(folder).items():
        point = POINTS[stage][random.integers(len(POINTS[stage]))]
        delay = random.uniform(0, _LONGEST)
        told.append(f"seed {seed}: {stage} killed {delay:.3f} s after {point[1]} of {point[0]}")
        _kill(given, folder, *point, delay, told[-1])
        _run(given)
    return "; ".join(told)


def _kill(given, folder, pattern, count, delay, told):
    process = start(*given)
    there = wait_for(lambda: len(list(folder.glob(pattern))) >= count, process)
    workers = workers_of(process.pid)
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        process.kill()
    said = process.communicate()[1]
    assert there, f"{told}: it was over\n{said[-2000:]}"
    assert process.returncode == -signal.SIGKILL, f"{told}: it was over\n{said[-2000:]}"
    assert workers or "run.json" not in pattern
    wait_for_the_end_of(workers)  # none is left behind


def ends(folder):
    """All bytes that kills must not change."""
    made = "study/encoders/face_direction/dae-4.safetensors"
    names = ["encoders/dae-4.safetensors", made]
    names += [f"study/{name}" for name in (RETURNS, REFERENCE_RETURNS, MARKDOWN)]
    names += sorted(str(path.relative_to(folder)) for path in folder.rglob("episodes.csv"))
    return contents(folder / "data") | {name: (folder / name).read_bytes() for name in names}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        peace = Path(temporary) / "peace"
        in_peace(peace)
        for seed in range(int(sys.argv[1])):
            told = killed(Path(temporary) / str(seed), seed)
            print(told, flush=True)
            assert ends(Path(temporary) / str(seed)) == ends(peace), told
