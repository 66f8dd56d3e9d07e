"""Every command, as a stranger would type it."""

import json
import re
import subprocess
import sys

import pytest
from click.testing import CliRunner
from stable_baselines3 import SAC

from jbrep.cli import main

COMMANDS = sorted(main.commands)


def jbrep(*arguments):
    result = CliRunner().invoke(main, [str(a) for a in arguments], prog_name="jbrep")
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def test_the_whole_pipeline(tmp_path):
    data, encoder, runs = tmp_path / "data", tmp_path / "dae-8", tmp_path / "runs"
    assert (
        "2 episodes of face_direction"
        in jbrep("collect", "--task", "face_direction", "--steps", "2k", "--out", data).output
    )
    trained = jbrep("train-dae", "--data", data, "--latent", 8, "--epochs", 2, "--out", encoder)
    assert re.search(r"held-out mean squared error [\d.]+ over 1,000 rows", trained.output)
    for state, arguments in {"dae-8": ("--encoder", encoder), "full": ()}.items():
        settings = ("--task", "face_direction", "--steps", 200, "--seed", 1, *arguments)
        assert f"returns on {state}: " in jbrep("rl", *settings, "--out", runs / state).output
        result = json.loads((runs / state / "run.json").read_text())
        assert len(result["returns"]) == 10
        agent = SAC.load(runs / state / "policy.zip")
        assert agent.observation_space.shape == ((8,) if state == "dae-8" else (16,))
    table = jbrep("report", runs).output.splitlines()
    assert [line.split()[:4] for line in table[1:]] == [
        ["face_direction", "sac", "dae-8", "1"],
        ["face_direction", "sac", "full", "1"],
    ]
    again = jbrep("rl", "--task", "face_direction", "--out", runs / "full")
    assert (again.exit_code, again.output.count("\n")) == (2, 1)
    assert "holds a finished run already" in again.output


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command):
    text = jbrep(command, "--help").output
    assert f"Example: jbrep {command}" in text
    for line in re.findall(r"^  -.*", text, re.MULTILINE):
        assert len(line.split(maxsplit=2)) > 2, line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("collect", "--task", "fly", "--steps", "1k", "--out", "x"), "unknown task 'fly'"),
        (("collect", "--task", "face_direction", "--steps", "-1", "--out", "x"), "at least 1"),
        (("train-dae", "--data", "none", "--latent", "8", "--out", "x"), "no data set in none"),
        (("rl", "--task", "fly", "--out", "x"), "choose one of move_from_origin"),
        (("rl", "--task", "face_direction", "--algorithm", "dqn", "--out", "x"), "ddpg, td3"),
        (("rl", "--task", "face_direction", "--encoder", "x", "--out", "y"), "no encoder at x"),
        (("report", "none"), "no finished run below none"),
        (("report",), "Missing argument 'FOLDER'. See jbrep report --help."),
        (("fly",), "No such command 'fly'. See jbrep --help."),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = jbrep(*arguments)
    assert result.exit_code == 2
    assert result.output.count("\n") == 1
    assert message in result.output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "steps"), [("1500", 2), ("1_000", 1), ("2k", 2), ("1e3", 1), ("0.001M", 1)]
)
def test_steps_may_be_written_in_many_ways(text, steps, tmp_path):
    out = tmp_path / "data"
    result = jbrep("collect", "--task", "move_to_pose", "--steps", text, "--out", out)
    assert f"{steps} episode" in result.output


@pytest.mark.parametrize("text", ["many", "1.5", "k", "1e999", "nan"])
def test_steps_that_are_no_number_are_refused(text, tmp_path):
    result = jbrep("collect", "--task", "move_to_pose", "--steps", text, "--out", tmp_path / "x")
    assert result.exit_code == 2
    assert "write it as 5000000, 5_000_000, 5e6 or 5M" in result.output


def test_a_missing_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "jbrep.dae", raising=False)
    result = jbrep("train-dae", "--data", tmp_path, "--latent", 8, "--out", tmp_path / "x")
    assert (result.exit_code, result.output) == (
        2,
        "Error: this needs torch: pip install 'jbrep[learn]'\n",
    )


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from jbrep.cli import main;"
        "main(['--help'], standalone_mode=False);"
        "print(sorted({'numpy', 'torch', 'gymnasium', 'mujoco', 'h5py'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("[]\n")
