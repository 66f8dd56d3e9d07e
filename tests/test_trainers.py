"""Verdicts on cohorts against stable-baselines3, of made-up returns whose truth is known."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from small import adopt

from jbrep.records.tables import write_rows
from jbrep.study.record import RECORD
from jbrep.study.tables import RETURNS, Return

SEEDS, STEPS, EPISODES = 20, (5_000, 10_000), 10
ARMS = {  # mean and standard deviation of runs
    "sac-sb3": (500, 40),
    "sac-float32": (500, 40),
    "sac-bfloat16": (620, 40),
    "ddpg-sb3": (500, 80),
    "ddpg-float32": (500, 190),
    "ddpg-bfloat16": (565, 110),
}


def write_arm(folder, mean, spread, rng):
    """The tables of a study with such returns."""
    folder.mkdir()
    algorithm, _, _ = folder.name.partition("-")
    shutil.copy(Path("results/confirm") / RECORD, folder)
    runs = rng.standard_normal(SEEDS)
    of_runs = mean + spread * (runs - runs.mean()) / runs.std(ddof=1)
    rows = (
        Return("face_direction", algorithm, "full", seed, step, episode, float(of_run))
        for seed, of_run in enumerate(of_runs)
        for step in STEPS
        for episode in range(EPISODES)
    )
    write_rows(folder / RETURNS, rows, Return)
    adopt(folder / RECORD, RETURNS)


def test_verdicts_go_by_the_rule(tmp_path):
    rng = np.random.default_rng(3)
    for arm, (mean, spread) in ARMS.items():
        write_arm(tmp_path / arm, mean, spread, rng)
    told = subprocess.run(
        [sys.executable, "tools/trainers.py", tmp_path], capture_output=True, text=True, check=True
    ).stdout
    sac, ddpg = told.split("\n\n")
    assert sac.splitlines()[-2:] == ["float32: equal, within 50 points", "bfloat16: different"]
    undecided = "undecided; 80% power to find equal means equal takes 16 runs on either side"
    assert ddpg.splitlines()[-2:] == ["float32: different", f"bfloat16: {undecided}"]
    assert (tmp_path / "summary.txt").read_text() == told
    assert list((tmp_path / "figures").glob("*.png"))
