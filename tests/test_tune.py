"""Weights & Biases as a logger, and Optuna around `jbrep.train`."""

import runpy
from argparse import Namespace

import wandb

from jbrep.envs import describe
from jbrep.rl import Run, Session, train
from jbrep.rl.history import Tracker

TASK = describe("Pendulum-v1", max_episode_steps=20)
RUN = Run.of(
    task=TASK,
    algorithm="a2c",
    preset="modern",
    steps=128,
    evaluation_episodes=1,
    overrides={"net_arch": [8]},
)


def test_a_search_goes_on_from_its_trials(tmp_path, capsys):
    search = runpy.run_path("examples/tune/tune.py")["main"]
    given = {"task": "Pendulum-v1", "algorithm": "a2c", "steps": 8, "out": tmp_path}
    for trials in (1, 2):
        search(Namespace(**given, trials=trials))
        assert len([*tmp_path.glob("trial-*")]) == trials
    assert "best: trial" in capsys.readouterr().out


def test_weights_and_biases_gets_what_tensorboard_gets(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    tracker = Tracker("jbrep", tmp_path / "run", {"algorithm": "a2c"})
    train(RUN, tmp_path / "run", Session(writers=[tracker]))
    (log,) = (tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb")
    assert b"evaluation/mean_return" in log.read_bytes()


def test_weights_and_biases_ends_no_run(tmp_path, monkeypatch, capsys):
    def fail(**_):
        raise wandb.errors.UsageError("no API key\nSecond line")

    monkeypatch.setattr(wandb, "init", fail)
    tracker = Tracker("jbrep", tmp_path / "run", {})
    assert train(RUN, tmp_path / "run", Session(writers=[tracker])).status == "finished"
    told = "Weights & Biases: no API key; the run goes on without it\n"
    assert capsys.readouterr().err == told
