"""Weights & Biases as a logger, and Optuna around `jbrep.train`."""

import runpy
from argparse import Namespace

import wandb

import jbrep

TASK = jbrep.describe("Pendulum-v1", max_episode_steps=20)


def test_a_search_goes_on_from_its_trials(tmp_path, capsys):
    search = runpy.run_path("examples/tune/tune.py")["main"]
    given = {"task": "Pendulum-v1", "algorithm": "a2c", "steps": 8, "out": tmp_path}
    for trials in (1, 2):
        search(Namespace(**given, trials=trials))
        assert len([*tmp_path.glob("trial-*")]) == trials
    assert "best: trial" in capsys.readouterr().out


def test_weights_and_biases_follows_tensorboard(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    wandb.init(project="jbrep", sync_tensorboard=True, dir=str(tmp_path))
    jbrep.train(TASK, tmp_path / "run", algorithm="a2c", steps=128, evaluation_episodes=1)
    wandb.finish()
    (log,) = (tmp_path / "wandb").glob("offline-run-*/*.wandb")
    assert b"evaluation/mean_return" in log.read_bytes()
