"""The scripts in examples/ walk through to their ends."""

import os
import re
import runpy
import socket
import struct
import sys
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from command import in_this_process
from small import ONE_EACH

from jbrep.envs.description import describe
from jbrep.evaluation import regression
from jbrep.play.sources import find_player
from jbrep.rl import Run, train
from jbrep.rl.controller import export, load_policy
from jbrep.rl.policy_file import find_shipped
from jbrep.studies.runner import BACKENDS

OWN = Path("examples/own/own.py").resolve()
LOG = Path("examples/log/notebook.py").resolve()
PAPER = Path("examples/paper/behaviour.py").resolve()

LESS = {  # to do in own.py
    "steps = 240\nevaluate_every = 120": "steps = 80\nfinal_episodes = 2",
    "episode_steps = 100": "episode_steps = 20",
    "range(200)": "range(20)",
    "--episode-steps 100 --steps 2k": "--episode-steps 100 --steps 500",
    "learning_rate=1e-3 --steps 4k": "learning_rate=1e-3 --steps 40 --evaluation-episodes 1",
    "--policy uniform:0.5+run:0.5 --steps 2k": "--policy uniform:0.5+run:0.5 --steps 500",
    "face_direction --steps {steps}": "face_direction --steps {steps} --episode-steps 100",
}


@pytest.mark.slow
@pytest.mark.usefixtures("one_figure")
@pytest.mark.filterwarnings("ignore")  # a user sees them once, if at all
def test_everything_that_one_can_bring(tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(BACKENDS, "local", in_this_process)
    monkeypatch.setattr("jbrep.envs.names._imported", [])  # it imports net
    monkeypatch.setattr(sys, "argv", [str(OWN), str(tmp_path / "out")])
    monkeypatch.syspath_prepend(OWN.parent)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    monkeypatch.setenv("MINARI_DATASETS_PATH", "")
    code = OWN.read_text()
    for usual, less in LESS.items():
        assert usual in code
        code = code.replace(usual, less)
    exec(compile(code, OWN, "exec"), {"__name__": "__main__", "__file__": str(OWN)})
    told = capfd.readouterr().out
    assert "the module and the file from ONNX give equal codes" in told
    assert "the data set that has grown equals the one collected at once" in told
    for made in ("study/report.html", "mine.rrd", "pendulum-encoders/pca-2.safetensors"):
        assert (tmp_path / "out" / made).stat().st_size > 1000, made
    assert (tmp_path / "out/mixed-encoders/pca-2.safetensors").stat().st_size > 1000


@pytest.mark.filterwarnings("ignore::jbrep.errors.Notice")
def test_the_notebook_goes_from_a_log_to_a_controller(tmp_path, monkeypatch, capsys):
    """At toy size; and as a page it has all its cells."""
    page_of = runpy.run_path("tools/site.py")["page_of"]
    monkeypatch.syspath_prepend(LOG.parent)
    monkeypatch.setattr(regression, "_STEPS", 50)
    monkeypatch.chdir(tmp_path)
    usual = "EPISODES, LIMIT, STEPS = 40, 1000, 20_000\n"
    code = LOG.read_text()
    assert usual in code
    exec(compile(code.replace(usual, "EPISODES, LIMIT, STEPS = 6, 60, 128\n"), LOG, "exec"), {})
    told = capsys.readouterr().out
    assert "6 of 60 steps" in told
    assert "16 sensors, such as position_x; an action every 0.01 s" in told
    assert re.search(r"the clone returns [\d.]+, what it learned from [\d.]+", told)
    page = page_of(code)
    assert page.startswith("# From a log to a controller\n\nWhat a robot")
    assert page.count("```python\n") == code.count("# %%\n") == 7


@pytest.fixture
def on_robot(monkeypatch, tmp_path):
    """The controller of a shipped policy, and a robot beside it."""
    monkeypatch.syspath_prepend("examples/robot")
    export(load_policy(find_shipped(describe("face_direction"))), tmp_path / "it.onnx")
    controller, robot = import_module("controller"), import_module("robot")
    with controller.listen(0) as link:
        yield controller, robot, controller.Controller(str(tmp_path / "it.onnx")), link


def served(controller, made, link, steps):
    """Its answers in a thread; what it counted, once that is done."""
    pool = ThreadPoolExecutor(1)
    counted = pool.submit(controller.serve, made, link, steps)
    pool.shutdown(wait=False)
    return counted


def test_a_robot_is_driven_as_its_run_would_drive_it(on_robot, capsys):
    controller, robot, made, link = on_robot
    counted = served(controller, made, link, 30)
    port = link.getsockname()[1]
    total = robot.play("face_direction", port, episode=0, steps=30, in_step=True)
    task = describe("face_direction", episode_steps=30)
    assert total == pytest.approx(find_player("trained", task).returns(1)[0], abs=1e-3)
    counted.result(10)
    assert f"return {total:.1f}, 0 actions late" in capsys.readouterr().out
    assert (made.repeat, len(made.seconds)) == (2, 15)  # each action is held


def test_a_robot_is_stopped_where_its_sensors_cannot_be_believed(on_robot):
    controller, _, made, link = on_robot
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.connect(link.getsockname())
        robot.settimeout(10)
        counted = served(controller, made, link, 8)
        good = np.zeros(16, np.float32)
        spoilt = [np.full(16, np.nan), np.full(16, 1e9), good[:3]]

        def answer(step, sensors):
            robot.send(struct.pack("<I", step) + np.asarray(sensors, np.float32).tobytes())
            while True:
                number, action = struct.unpack("<If", robot.recv(100))
                if number == step or len(sensors) != 16:
                    return action

        assert answer(0, good) != 0
        assert [answer(step, sensors) for step, sensors in enumerate(spoilt, 1)] == [0, 0, 0]
        assert answer(4, good) != 0
        assert struct.unpack("<If", robot.recv(100)) == (4, 0)  # the watchdog, after three periods
        assert answer(7, good) != 0
        assert counted.result(10) > 3


def test_an_angle_with_and_without_its_jump(monkeypatch):
    """Two states on either side of the jump: one encoder tells them apart, the other doesn't."""
    monkeypatch.syspath_prepend("examples/jump")
    jump = import_module("jump")
    sides = torch.zeros(2, 16)
    sides[:, 3] = 1  # upright
    sides[:, -1] = torch.tensor([3.14, -3.14])
    for encoder, size, apart in ((jump.WithJump(), 22, 2), (jump.WithoutJump(), 17, 0)):
        codes = encoder(sides)
        assert codes.shape == (2, size)
        assert float((codes[0] - codes[1]).abs().max()) == pytest.approx(apart, abs=0.01)


def test_behaviour_of_policies_is_tabled_and_drawn(tmp_path, monkeypatch, capsys):
    """A constant action turns the motor one way; the heuristic goes where the target points."""
    shorter = partial(describe, episode_steps=400)
    monkeypatch.setattr("jbrep.envs.describe", shorter)
    task = shorter("move_in_direction")
    train(Run.of(task, "a2c", steps=80, preset="paper", **ONE_EACH), tmp_path / "run")
    policies = ["constant:drive=0.5", "heuristic", str(tmp_path / "run")]
    options = "--task", "move_in_direction", "--episodes", "2", "--target-yaw", "30"
    monkeypatch.setattr(sys, "argv", [str(PAPER), *policies, *options, "--out", str(tmp_path)])
    runpy.run_path(str(PAPER), run_name="__main__")
    names = ("motor_velocity", "positions")
    motor, places = (pd.read_csv(tmp_path / f"{name}.csv") for name in names)
    assert {*motor.policy} == {*policies[:2], "run", "run, before training"}
    assert motor.groupby("policy").share.sum().to_numpy() == pytest.approx([1] * 4)
    assert places.groupby("policy").share.sum().to_numpy() == pytest.approx([1] * 4)
    one_way = motor[(motor.policy == policies[0]) & (motor.low > 50)]
    assert one_way.share.sum() > 0.9  # 145 rad/s at full drive
    ours = places[places.policy == "heuristic"]
    x, y = (ours[each] @ ours.share for each in "xy")
    assert np.rad2deg(np.arctan2(y, x)) == pytest.approx(30, abs=14)
    assert capsys.readouterr().out.count("mean place") == 4
    assert (tmp_path / "positions.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_search_goes_on_from_its_trials(tmp_path, capsys):
    search = runpy.run_path("examples/tune/tune.py")["main"]
    given = {"task": "Pendulum-v1", "algorithm": "a2c", "steps": 8, "out": tmp_path}
    for trials in (1, 2):
        search(Namespace(**given, trials=trials))
        assert len([*tmp_path.glob("trial-*")]) == trials
    assert "best: trial" in capsys.readouterr().out
