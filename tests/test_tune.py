"""The search for settings, and Weights & Biases as a logger."""

import tomllib

import pytest
import wandb
from command import jbrep, mistake
from small import ONE_EACH

from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.rl import Run, Session, StoppedError, train
from jbrep.rl.files import POLICY, read_run, runs_below
from jbrep.rl.history import Tracker
from jbrep.rl.learner import read_preset
from jbrep.rl.tune import BEST, _space, tune

TASK = describe("Pendulum-v1", max_episode_steps=20)
RUN = Run.of(
    task=TASK,
    algorithm="a2c",
    preset="modern",
    steps=128,
    overrides={"net_arch": [8]},
    **ONE_EACH,
)


@pytest.mark.parametrize(("preset", "searched"), [("paper", False), ("modern", True)])
def test_steps_between_rollouts_are_searched_where_gradient_steps_follow(preset, searched):
    """Else a thousand gradient steps, meant for a thousand of the robot's, could follow each."""
    run = Run.of(TASK, "td3", preset=preset, steps=1000)
    gradient_steps = run.learner.hyperparameters.algorithm_kwargs.get("gradient_steps")
    assert ("train_freq" in _space(run)) == (gradient_steps is None) == searched


def test_nothing_is_searched_where_nothing_would_be_learned(tmp_path):
    run = Run.of(TASK, "sac", steps=20_000)
    with pytest.raises(
        InputError, match="steps is 20,000, and sac-wide learns from step 25,600 on"
    ):
        tune(run, 2, 1, tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_a_stopped_search_resumes_to_the_same_trials(tmp_path):
    whole, parts = [], []
    best = tune(RUN, 3, 1, tmp_path / "whole", whole.append)
    asked = iter(range(100))
    with pytest.raises(StoppedError):  # in the second trial
        tune(RUN, 3, 1, tmp_path / "parts", parts.append, stop=lambda: next(asked) == 3)
    assert parts == whole[:1]
    assert tune(RUN, 3, 1, tmp_path / "parts", parts.append) == best
    assert parts[1:] == whole
    with pytest.raises(InputError, match="whole has 3 trials: ask for as many, or more"):
        tune(RUN, 1, 1, tmp_path / "whole")
    assert best == max(whole, key=lambda trial: trial.value)
    assert len({trial.overrides["learning_rate"] for trial in whole}) == 3
    expected = ("modern", {"net_arch": [8], **best.overrides})
    assert read_preset(tmp_path / "whole" / BEST, "a2c") == expected
    ours, theirs = (tmp_path / each / "trial-1/seed-0" / POLICY for each in ("whole", "parts"))
    assert ours.read_bytes() == theirs.read_bytes()
    names = {run.settings.learner for run in map(read_run, runs_below(tmp_path / "whole"))}
    assert len(names) == 3
    assert all(name.startswith("a2c-modern+net_arch=8+") for name in names)
    with pytest.raises(InputError, match="holds another search: seeds 1"):
        tune(RUN, 3, 2, tmp_path / "whole")


def test_the_command_writes_a_preset_that_rl_takes(tmp_path):
    search = ("--task", TASK.id, "--episode-steps", 20, "--algorithm", "a2c", "--steps", 8)
    quick = (*search, "--evaluation-episodes", 1, "--out", tmp_path / "it")
    told = jbrep("tune", *quick, "--trials", 1, "--preset", "modern", "--set", "net_arch=[8]")
    assert told.exit_code == 0, told.output
    assert "trial 1 of 1: -" in told.output
    assert tomllib.loads((tmp_path / "it" / BEST).read_text())["a2c"]["net_arch"] == [8]
    preset = ("--preset", tmp_path / "it" / BEST)
    told = jbrep("rl", *search, "--evaluation-episodes", 1, *preset, "--out", tmp_path / "run")
    assert told.exit_code == 0, told.output


def test_a_folder_with_other_things_is_no_search(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    told = mistake("tune", "--task", "face_direction", "--out", tmp_path)
    assert "holds other things, such as thesis.txt" in told
    told = mistake("tune", "--task", "face_direction", "--seeds", 1 << 31, "--out", tmp_path / "a")
    assert "seeds is 2,147,483,648: it must be from 1 to 1,000" in told


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
