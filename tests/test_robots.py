"""Other people's robots: that exist once, fail, miss readings, change."""

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import arms
import gymnasium
import numpy as np
import pytest
from arms import STEPS, Arm
from command import jbrep, mistake, refused
from small import contents

from jbrep.api import evaluate_policy
from jbrep.collecting import collect
from jbrep.dataset import Dataset, DataSettings
from jbrep.dataset.manifest import find_problems
from jbrep.envs import describe, make
from jbrep.envs.autoreset import AutoresetEnvironments
from jbrep.envs.names import import_modules
from jbrep.rl.files import read_run

import_modules(["arms", "environments"])
HOPPER = Path(gymnasium.__file__).parent / "envs/mujoco/assets/hopper.xml"


@pytest.fixture(autouse=True)
def fresh():
    """No port is open, and the steps of all are counted anew."""
    make.close_all()
    Arm.steps_of_all = 0
    yield
    make.close_all()
    assert Arm.ports == 0


def arm(tmp_path, *options, **arguments):
    """The words of a command that say which arm it is."""
    given = {"log": str(tmp_path / "log"), **arguments}
    pairs = [f"{name}={json.dumps(value)}" for name, value in given.items()]
    return ("--task", arms.ID, *(word for pair in pairs for word in ("--env", pair)), *options)


def events(tmp_path):
    return (tmp_path / "log").read_text()


def closed(tmp_path):
    """Whether all that was opened was closed, one after the other."""
    left = events(tmp_path).replace("f", "")
    return left == "oc" * (len(left) // 2)


def hopper(path, gear):
    """The words of a command for a hopper with its own model."""
    text = HOPPER.read_text()
    assert 'gear="200.0"' in text
    path.write_text(text.replace('gear="200.0"', f'gear="{gear}"'))
    return "--task", "Hopper-v5", "--env", f"xml_file=./{path.name}", "--episode-steps", 20


def test_another_robot_under_the_same_name_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, model = hopper(Path("mine.xml"), 200.0), Path("mine.xml")
    command = ("collect", *robot, "--shard-episodes", 3, "--threads", 1, "--out", "d")
    assert jbrep(*command, "--steps", 70).exit_code == 0
    before = contents(Path("d"))
    hopper(model, 100.0)
    assert "files.xml_file" in mistake(*command, "--steps", 200)
    assert contents(Path("d")) == before
    told = jbrep("data", "verify", "d", "--replay", 2)
    assert (told.exit_code, "simulated again differs" in told.output) == (1, True)
    hopper(model, 200.0)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir("other")  # the path is absolute
    assert "equal in every bit" in jbrep("data", "verify", "../d", "--replay", 2).output
    monkeypatch.chdir("..")
    assert jbrep(*command, "--steps", 200).exit_code == 0
    assert jbrep(*command[:-1], "e", "--steps", 200).exit_code == 0
    assert contents(Path("d")) == contents(Path("e"))


def test_an_episode_is_played_again_before_a_data_set_grows(tmp_path, monkeypatch):
    """What an environment is beyond its own files shows in what it does."""
    task = describe("Sledges/Sledge-v0")
    settings = DataSettings(task=task, steps=60, shard_episodes=50)
    collect(settings, tmp_path / "d", num_threads=1)
    before = contents(tmp_path / "d")
    monkeypatch.setattr("environments.Sledge.dt", 0.1)  # nothing that it does
    collect(settings.replace(steps=80), tmp_path / "d", num_threads=1)
    observe = import_module("environments").Sledge.observe
    monkeypatch.setattr("environments.Sledge.observe", lambda self: observe(self) * 1.001)
    told = refused(lambda: collect(settings.replace(steps=300), tmp_path / "d", num_threads=1))
    assert "when it is played again" in told
    monkeypatch.undo()
    again = collect(settings.replace(steps=80), tmp_path / "e", num_threads=1)
    assert again == Dataset(tmp_path / "d").manifest
    assert len(contents(tmp_path / "d")) == len(before)


def test_a_clock_that_32_bits_swallow_is_told_and_shifted(tmp_path):
    robot = arm(tmp_path, clock=1764000000.25)
    told = jbrep("collect", *robot, "--steps", 50, "--threads", 1, "--out", tmp_path / "d")
    assert told.exit_code == 0
    assert "128 apart there" in told.stderr
    assert np.ptp(Dataset(tmp_path / "d")["clock"][:]) == 0
    features = tmp_path / "features.toml"
    order = describe(arms.ID, {"log": str(tmp_path / "log")}).feature_names
    rows = [f"offset = {1764000000 if name == 'clock' else 0}" for name in order]
    features.write_text("".join(f"[[features]]\n{row}\n" for row in rows))
    again = ("--features", features, "--threads", 1, "--out", tmp_path / "e")
    told = jbrep("collect", *robot, "--steps", 50, *again)
    assert (told.exit_code, "apart there" in told.output) == (0, False)
    dataset = Dataset(tmp_path / "e")
    clock = 0.25 + 0.02 * dataset["step"][:]
    np.testing.assert_allclose(dataset["clock"][:], clock, atol=1e-6)
    assert dataset.task.offsets == {"clock": 1764000000.0}
    assert jbrep("data", "verify", tmp_path / "e", "--replay", 1).exit_code == 0


def test_two_instances_of_a_class_are_two_robots():
    class Paid(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,))

        def __init__(self, pay):
            self.pay = pay

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(1, np.float32), {}

        def step(self, action):
            return np.zeros(1, np.float32), self.pay, False, False, {}

    few, many = (describe(Paid(pay), episode_steps=5) for pay in (1.0, 100.0))
    assert few.id != many.id
    assert [evaluate_policy("still", task=each, episodes=1)[0] for each in (few, many)] == [5, 500]


def test_one_instance_describes_collects_and_evaluates(tmp_path):
    robot = arm(tmp_path)
    told = jbrep("env", *robot[1:], "--json")
    assert json.loads(told.stdout)["id"] == arms.ID  # what the robot prints goes elsewhere
    assert closed(tmp_path)
    data = tmp_path / "d"
    assert jbrep("collect", *robot, "--steps", 60, "--threads", 1, "--out", data).exit_code == 0
    told = jbrep("evaluate-policy", "uniform", *robot, "--episodes", 3, "--json")
    assert len(json.loads(told.stdout)["returns"]) == 3
    assert events(tmp_path) == "oc" * 3


@pytest.mark.parametrize(("algorithm", "drifts"), [("sac", False), ("ppo", True)])
def test_training_and_evaluation_share_the_one_robot(algorithm, drifts, tmp_path, monkeypatch):
    """Evaluations wait for the end of an episode; normalised observations are the new ones."""
    begun, restart = [], AutoresetEnvironments.restart
    monkeypatch.setattr(
        AutoresetEnvironments, "restart", lambda envs: begun.append(envs) or restart(envs)
    )
    run = ("rl", *arm(tmp_path, drifts=drifts), "--algorithm", algorithm, "--normalize")
    small = "learning_starts=10" if algorithm == "sac" else "n_steps=32"
    run = (*run, "--set", small, "--set", "batch_size=8", "--evaluate-every", 40)
    run = (*run, "--evaluation-episodes", 2, "--final-episodes", 3, "--steps", 128, "--threads", 1)
    told = jbrep(*run, "--out", tmp_path / "run")
    assert told.exit_code == 0, told.output
    assert events(tmp_path) == "oc"
    assert "standing still" not in told.output  # no policy that doesn't look drives it
    rows = (tmp_path / "run" / "evaluations.csv").read_text().splitlines()[1:]
    steps = list(dict.fromkeys(int(row.split(",")[0]) for row in rows))
    assert steps == [0, 50, 100, 125, 128]
    assert len(rows) == 11
    assert len(begun) == 4  # not after the last


def test_what_fails_is_closed_kept_and_tried_again(tmp_path):
    """In the third episode that is collected."""
    describe(arms.ID, {"log": str(tmp_path / "log")})
    probe, Arm.steps_of_all = Arm.steps_of_all, 0
    make.close_all()
    (tmp_path / "log").unlink()
    robot = arm(tmp_path, fails=[probe + 2 * STEPS + 7])
    command = ("collect", *robot, "--steps", 100, "--threads", 1, "--out", tmp_path / "d")
    told = jbrep(*command, "--shard-episodes", 2)
    assert told.exit_code == 2
    assert "OSError: no answer; 2 episodes of 50 rows are kept" in told.output
    assert events(tmp_path) == "ofc"
    assert not list(find_problems(tmp_path / "d"))
    assert len(Dataset(tmp_path / "d")) == 50
    told = jbrep(*command, "--shard-episodes", 2)  # the port has no such step any more
    assert told.exit_code == 0, told.output
    Arm.steps_of_all = 0
    peace = (*command[:-1], tmp_path / "e", "--shard-episodes", 2, "--retries", 1)
    told = jbrep(*peace)
    assert told.exit_code == 0, told.output
    assert "no answer; retrying" in told.stderr
    assert contents(tmp_path / "d") == contents(tmp_path / "e")
    assert closed(tmp_path)


def test_evaluations_and_training_go_on_after_failures(tmp_path):
    robot = arm(tmp_path, fails=[500, 620])
    policy = ("evaluate-policy", "uniform", *robot, "--episodes", 40, "--threads", 1, "--json")
    told = jbrep(*policy)
    assert told.exit_code == 1
    kept = json.loads(told.stdout)["returns"]
    assert f"{len(kept)} of 40 episodes were finished" in told.stderr
    Arm.steps_of_all = 0
    told = jbrep(*policy, "--retries", 1)
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["returns"][: len(kept)] == kept
    Arm.steps_of_all = 0
    run = ("rl", *robot, "--algorithm", "sac", "--evaluation-episodes", 2, "--final-episodes", 2)
    run = (*run, "--steps", 600, "--threads", 1, "--set", "learning_starts=1000")
    told = jbrep(*run, "--retries", 1, "--out", tmp_path / "run")
    assert told.exit_code == 0, told.output
    assert told.stderr.count("no answer; retrying") == 2
    assert read_run(tmp_path / "run").status == "finished"
    assert closed(tmp_path)


def test_missing_readings_are_held_or_end_an_episode_and_counted(tmp_path):
    robot = arm(tmp_path, gaps=[4, 5, 9])
    command = ("collect", *robot, "--steps", 30, "--threads", 1, "--out", tmp_path / "d")
    told = jbrep(*command)
    assert (told.exit_code, "at step 4" in told.output) == (2, True)
    told = jbrep(*command[:-1], tmp_path / "held", "--missing", "hold:2")
    assert told.exit_code == 0, told.output
    held = Dataset(tmp_path / "held")
    angle = held["angle"][:STEPS]
    assert angle[3] == angle[4] == angle[5] != angle[6]
    assert angle[8] == angle[9]
    reward = held["reward"][:STEPS]  # of the state that an action led to
    assert reward[2] == reward[3] == reward[4] != reward[5]
    assert held.episodes["missing"].tolist() == [6, 6]
    assert jbrep("data", "verify", tmp_path / "held", "--replay", 2).exit_code == 0
    told = jbrep(*command[:-1], tmp_path / "x", "--missing", "hold:1")
    assert (told.exit_code, "at step 5" in told.output) == (2, True)
    told = jbrep(*command[:-1], tmp_path / "cut", "--missing", "skip")
    assert told.exit_code == 0, told.output
    cut = Dataset(tmp_path / "cut")
    assert set(cut.episodes["length"].tolist()) == {3}
    assert cut.episodes["truncated"].all()
    np.testing.assert_array_equal(cut.episodes["final_observation"][0], held["observation"][3])
    assert not list(find_problems(tmp_path / "cut"))
    assert jbrep("data", "verify", tmp_path / "cut", "--replay", 2).exit_code == 0


def test_a_reward_in_an_array_and_a_joint_that_can_t_move(tmp_path):
    log = str(tmp_path / "log")
    task = describe(arms.ID, {"log": log, "reward": "array", "locked": True})
    assert task.action_low[1] == task.action_high[1] == np.float32(0.3)
    settings = DataSettings(task=task, steps=50)
    collect(settings, tmp_path / "d", num_threads=1)
    dataset = Dataset(tmp_path / "d")
    assert (dataset["action"][:][:, 1] == np.float32(0.3)).all()
    assert (dataset["reward"][:] < 0).all()
    told = refused(describe, arms.ID, {"log": log, "reward": "pair"})
    assert "gave a reward of shape (2,): it must be one number" in told


def test_a_script_without_a_main_guard_collects_in_processes_if_they_can(tmp_path):
    script = Path(__file__).parent / "helpers" / "unguarded.py"
    told = subprocess.run(
        [sys.executable, script, tmp_path], capture_output=True, text=True, check=False
    )
    assert (told.returncode, told.stderr.count("Traceback")) == (0, 0), told.stderr
    assert len(told.stdout.split()) == 2
    here, there = (Dataset(tmp_path / name) for name in ("Here", "There"))
    np.testing.assert_array_equal(here["observation"][:], there["observation"][:])
