"""Whatever an environment does to its process, a command ends in what was asked, or in a line."""

import itertools
import json
import os
import signal
import sys
import traceback

import pytest
from command import jbrep as command
from odd import FAILS, HARMLESS

from jbrep.cli import main
from jbrep.dataset import Dataset

TASK = ("--task", "odd:Odd-v0")
COMMANDS = {
    "env": ("env", "odd:Odd-v0", "--json"),
    "collect": ("collect", *TASK, "--steps", "60", "--threads", "1", "--out", "out"),
    "rl": (
        *("rl", *TASK, "--algorithm", "a2c", "--preset", "modern", "--steps", "64"),
        *("--set", "num_envs=1", "--evaluation-episodes", "1", "--final-episodes", "1"),
        *("--out", "out"),
    ),
    "evaluate-policy": ("evaluate-policy", "uniform", *TASK, "--episodes", "2", "--json"),
    "inspect": ("inspect", "uniform", *TASK, "--out", "out.rrd"),
}
SECONDS = 60
STALL = "a stall"
WHEN = ("make", "reset", "step")


def in_a_fork(arguments, folder):
    """A command in a process of its own, which begins as this one is: exit code, output, errors."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "stdout", folder / "stderr"]
    child = os.fork()
    if not child:
        code = 70
        try:
            signal.alarm(SECONDS)
            os.chdir(folder)
            for descriptor, file in enumerate(files, start=1):
                os.dup2(os.open(file, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), descriptor)
            sys.stdout = sys.__stdout__ = open(1, "w", closefd=False)  # noqa: SIM115
            sys.stderr = sys.__stderr__ = open(2, "w", closefd=False)  # noqa: SIM115
            try:
                main([*arguments], prog_name="jbrep")
            except SystemExit as error:
                code = error.code or 0
        except BaseException:
            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):
                if not stream.closed:
                    stream.flush()
            os._exit(code if isinstance(code, int) else 71)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), *(file.read_text() for file in files)


def played(command, how, when, folder):
    """What a command does in an environment that does that: exit code, output, errors."""
    said = ("--env", f"how={how}", "--env", f"when={when}") if how else ()
    said += ("--step-timeout", "0.5") if how == STALL else ()
    return in_a_fork((*COMMANDS[command], *said), folder)


def result(command, folder, output):
    """What a command was asked for, as far as it can be compared."""
    if command == "env":
        return json.loads(output)["features"]
    if command == "collect":
        data = Dataset(folder / "out")
        return [data[name][:].tobytes() for name in ("observation", "action", "reward")]
    if command == "rl":
        return (folder / "out/episodes.csv").read_bytes()
    if command == "evaluate-policy":
        return json.loads(output)
    return (folder / COMMANDS[command][-1]).stat().st_size > 1000


def problem(command, how, when, folder):
    """What is wrong with how a command ends; None if nothing is."""
    code, output, errors = played(command, how, when, folder)
    if "Traceback" in errors or code not in (0, 2):
        return f"exit code {code}: {errors[-300:]}"
    if how in FAILS:
        lines = [line for line in errors.splitlines() if line.startswith("Error: ")]
        good = code == 2 and len(lines) == 1 and len(lines[0]) < 1000
        return None if good else f"exit code {code}: {errors[-300:]}"
    plain = folder.with_name(f"{command}-plain")
    if not (plain / "stdout").exists():
        assert played(command, "", "", plain)[0] == 0
    try:
        same = result(command, folder, output) == result(
            command, plain, (plain / "stdout").read_text()
        )
    except (OSError, ValueError) as error:
        return f"exit code {code}: {error}; {errors[-300:]}"
    return None if same else "another result"


CASES = [  # each thing with one command and one moment; tools/odd.py tries all
    (how, command, when if how != STALL else "step")  # making it may take its time
    for how, (command, when) in zip(
        (*HARMLESS, *FAILS),
        itertools.cycle(zip(itertools.cycle(COMMANDS), itertools.cycle(WHEN * 2 + WHEN[:1]))),
        strict=False,
    )
]


@pytest.mark.parametrize(("how", "command", "when"), CASES)
def test_a_command_ends_in_what_was_asked_or_in_a_line(how, command, when, tmp_path):
    assert problem(command, how, when, tmp_path / "it") is None


@pytest.mark.slow
def test_a_worker_s_environment_may_have_processes_too(tmp_path):
    task = ("--task", "odd:Odd-v0", "--env", "how=a simulator", "--env", "when=make")
    sizes = ("--steps", 48, "--shard-episodes", 2, "--threads", 2)
    told = command("collect", *task, *sizes, "--out", tmp_path / "data")
    assert told.exit_code == 0, told.output
