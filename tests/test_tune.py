"""Optuna around `jbrep.train`."""

import runpy
from argparse import Namespace

import pytest

import jbrep

TASK = jbrep.describe("Pendulum-v1", episode_steps=20)


@pytest.mark.slow
def test_a_search_goes_on_from_its_trials(tmp_path, capsys):
    search = runpy.run_path("examples/tune/tune.py")["main"]
    given = {"task": "Pendulum-v1", "algorithm": "a2c", "steps": 8, "out": tmp_path}
    for trials in (1, 2):
        search(Namespace(**given, trials=trials))
        assert len([*tmp_path.glob("trial-*")]) == trials
    assert "best: trial" in capsys.readouterr().out
