"""Every command, as a stranger would type it."""

import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from importlib.metadata import packages_distributions, version
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner
from command import jbrep, mistake
from msgspec import Meta, field
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from stable_baselines3 import A2C
from test_study import TOML

from jbrep import doctor
from jbrep.cli import main
from jbrep.cli.generator import Command
from jbrep.encoders import find, save
from jbrep.encoders.shipped import unlearned
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.evaluation.table import Diagnosed, diagnostics_text
from jbrep.jitterbug.tasks import TASKS
from jbrep.records.record import Record, from_text
from jbrep.rl.files import read_evaluations

GROUPS = ("data", "encoder", "policy")
COMMANDS = sorted({*main.commands} - {*GROUPS}) + [
    f"{group} {name}" for group in GROUPS for name in sorted(main.commands[group].commands)
]


NEEDS_NOTHING = {"doctor", "check", "encoder list", "inspect", "policies"}


@pytest.mark.parametrize("command", sorted({*COMMANDS} - NEEDS_NOTHING))
def test_what_a_command_needs_is_asked_for(command):
    assert "Missing" in mistake(*command.split())


def test_a_run_from_training_to_its_returns(tmp_path):
    run = tmp_path / "runs" / "dae-8"
    settings = ("--task", "face_direction", "--algorithm", "a2c", "--preset", "paper")
    settings += ("--steps", 40, "--episode-steps", 20, "--final-episodes", 12)
    for _ in range(2):  # the second time it is over
        given = (*settings, "--encoder", "dae-8", "--evaluation-episodes", 1, "--out", run)
        said = jbrep("rl", *given).output
        told, number = " ".join(said.split()), r"(-?[\d.]+)"
        beside = rf"standing still {number}, constant action {number}, random {number}"
        found = re.search(rf"final return on dae-8 [a-z ]*: {number} \[.*; from .*{beside}", told)
        final = [each.episode_return for each in read_evaluations(run) if each.step >= 40]
        assert len(final) == 12
        assert float(found[1]) == pytest.approx(np.mean(final), rel=0.01)
    assert A2C.load(run / "policy.zip", device="cpu").observation_space.shape == (8,)
    told = jbrep("evaluate-policy", run, "--episodes", 2).output
    assert re.fullmatch(
        r"face_direction on dae-8: median return [\d.]+ \[[\d.]+, [\d.]+\] .*\n", told
    )
    table = jbrep("report", tmp_path / "runs").output.splitlines()
    ended = ["face_direction/a2c-paper/dae-8", "0", "finished"]
    assert ended in [line.split()[:3] for line in table]
    why = "face_direction/a2c-paper/dae-8: one run has ended, at least two are needed"
    assert f"No statistics: {why}" in " ".join(table)
    assert (tmp_path / "runs" / "returns.csv").exists()
    again = jbrep("rl", "--task", "face_direction", "--seed", 1, "--out", run)
    assert (again.exit_code, again.output.count("\n")) == (2, 1)
    assert "holds another run: algorithm a2c (now: sac)" in again.output


def test_a_studys_dry_run_and_its_mistakes(tmp_path):
    (tmp_path / "tiny.toml").write_text(TOML)
    dry = ("study", tmp_path / "tiny.toml", "--dry-run", "--workers", 2, "--out", tmp_path / "dry")
    told = jbrep(*dry).output
    assert re.search(r"\nface_direction/a2c-paper/pca-8 +2 +[\d.]+ \w+\n", told)
    assert re.search(r"4 runs to go, 0 done; [\d.]+ \w+ on one core, [\d.]+ \w+ with 2 ", told)
    for arguments, message in (
        (("studies/none.toml",), "studies/none.toml"),
        (("demo", "--backend", "slurm"), "unknown backend 'slurm': choose one of local, ray"),
        (("README.md",), "README.md is not valid TOML"),
    ):
        refused = jbrep("study", *arguments, "--out", tmp_path / "dry")
        assert (refused.exit_code, refused.output.count("\n")) == (2, 1), refused.output
        assert message in refused.output
    assert not (tmp_path / "dry").exists()


def test_folders_of_other_things_are_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    short = ("--task", "face_direction", "--episode-steps", 10)
    for command in (
        ("collect", *short, "--steps", 10),
        ("rl", *short, "--steps", 10),
        ("study", "demo"),
        ("evaluate", "--encoder", "pca-4", "--data", "data/sample/face_direction"),
        ("report", "results/cart-pole"),
    ):
        told = jbrep(*command, "--out", tmp_path)
        assert told.exit_code == 2
        assert "holds other things, such as notes.txt: choose" in told.output.splitlines()[-1]
        assert [each.name for each in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command):
    text = jbrep(*command.split(), "--help").output
    assert f"Example: jbrep {command}" in text
    for line in re.findall(r"^  -.*", text, re.MULTILINE):
        assert len(line.split(maxsplit=2)) > 2, line


MISTAKES = {
    "collect --task fly --steps 1k --out x": "unknown task 'fly'",
    "env environments:Sledge": "Sledge has no time limit: give one with --episode-steps",
    "train-dae --data none --latent 8 --out x": "no data set in none",
    "data derive none --hide x --out x": "no data set in none",
    "encoder import a.onnx --out x": "give --task, or else --data",
    "data fly": "No such command 'fly'. See jbrep data --help.",
    "evaluate-policy none": "none is no data set, no run",
    "collect --task face_direction --steps 1 --policy sprint --out x": "unknown policy 'sprint'",
    "train-dae --data none --out x": "dae needs --latent, such as --latent 12 8 4",
    "train-encoder --kind pca --data x --latent 8 --seed 1 --out x": "pca takes no --seed: leave i",
    "train-dae --data x --latent 8 --architecture wide --out x": "unknown architecture 'wide'",
    "train-encoder --data x --out x --kind slow --latent 8 --lags 5 0": "lags[1] is '0': it must",
    "train-encoder --data x --out x --kind dae --latent 12 8,x": "latent is 'x'",
    "train-encoder --data x --out x --kind dae --latent 8 --seeds 2 --seed 1": "--seed is for one",
    "evaluate --encoder dae-8 --data none": "no data set in none",
    "encoder info none": "no encoder at none",
    "encoder info dae-9 --task face_direction": "no encoder 'dae-9'",
    "rl --task face_direction --out x --device tpu": "device is 'tpu': it must be one of",
    "report none": "none is not the folder of a study",
    "report": "Missing argument 'FOLDER'. See jbrep report --help.",
    "fly": "No such command 'fly'. See jbrep --help.",
}


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_one_line_and_exit_code_2(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = jbrep(*command.split())
    assert (result.exit_code, result.output.count("\n")) == (2, 1)
    assert MISTAKES[command] in result.output
    assert not list(tmp_path.iterdir())


def test_the_encoders_that_ship_are_listed(monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", "80")
    text = jbrep("encoder", "list").output
    assert max(map(len, text.splitlines())) <= 80
    assert all(task in text for task in TASKS)
    monkeypatch.setattr("jbrep.encoders.shipped._FOLDER", tmp_path)
    folder = tmp_path / "face_direction"
    folder.mkdir()
    task = describe("face_direction")
    save(unlearned(task), folder / "full.safetensors")
    for name in ("pca-8", "pca-4"):
        shutil.copy(Path("jbrep/encoders/shipped/face_direction", f"{name}.safetensors"), folder)
    given = {"forward": 0.512, "rewarded": 0.25, "reward": None}
    shas = {name: find(name, task).fingerprint for name in ("full", "pca-8")}
    rows = [Diagnosed(task.name, name, sha, given) for name, sha in shas.items()]
    text = diagnostics_text([*rows, rows[1]._replace(sha256="another")])
    (folder / "diagnostics.csv").write_text(text)
    lines = jbrep("encoder", "list", "--task", "face_direction").output.splitlines()
    cells = [line.split()[:5] for line in lines[:5]]
    assert cells[1:] == [
        ["encoder", "l", "forward", "rewarded", "reward"],
        ["full", "16", "0.51", "0.25", "-"],
        ["pca-8", "8", "0.51", "0.25", "-"],
        ["pca-4", "4", "-", "-", "-"],
    ]
    refused = jbrep("encoder", "list", "--task", "Hopper-v5")
    assert (refused.exit_code, refused.output.count("\n")) == (2, 1)
    assert "no encoder ships for Hopper-v5: only for move_from_origin" in refused.output


def test_a_data_set_from_collecting_to_exporting(tmp_path):
    data, derived = tmp_path / "data", tmp_path / "derived"
    arguments = ("collect", "--task", "face_direction", "--steps", "1.1k", "--store-state")
    arguments += ("--episode-steps", 600, "--shard-episodes", 1, "--out", data)
    told = jbrep(*arguments).output
    assert re.search(r"2 episodes of face_direction, 1,200 rows, 0.01 s apart, 0\.\d MB in", told)
    assert re.search(r"1,200 rows in \d+ s, [\d,]+ a second", told)
    told = jbrep(*arguments)
    assert (told.exit_code, "already complete: nothing to do" in told.output) == (0, True)
    assert re.search(r"episodes +2 of 600 steps\n", jbrep("data", "info", data).output)
    told = jbrep("data", "verify", data, "--replay", 2)
    assert "no problems in 1,200 rows, 2 shards" in told.output
    assert "2 episodes simulated again: equal in every bit" in told.output
    told = jbrep("data", "derive", data, "--history", 2, "--out", derived)
    assert "1,200 rows" in told.output
    told = jbrep("data", "export", derived, "--to", "npz", "--out", tmp_path / "data.npz")
    assert f"open it with numpy.load('{tmp_path / 'data.npz'}')\n" in told.output
    (data / "shard-00001.h5").unlink()
    told = jbrep("data", "verify", data)
    assert (told.exit_code, told.output.count("\n")) == (1, 1)
    assert "shard-00001.h5 is missing" in told.output


@pytest.mark.parametrize(
    ("text", "steps"),
    [("1500", 1500), ("1_000", 1000), ("2k", 2000), ("1e3", 1000), ("5M", 5e6), ("1.005k", 1005)],
)
def test_steps_may_be_written_in_many_ways(text, steps):
    assert from_text(text, int, "steps") == steps


@pytest.mark.parametrize(
    ("package", "extra", "users", "command"),
    [
        ("torch", "learn", ("jbrep.methods.fit",), "train-dae --latent 8 --data {}"),
        ("minari", "export", "jbrep.dataset.formats.minari", "data export {} --to minari"),
    ],
)
def test_a_missing_extra_is_named(package, extra, users, command, monkeypatch, tmp_path, collected):
    monkeypatch.setitem(sys.modules, package, None)
    for name in [name for name in sys.modules if name.startswith(users)]:
        monkeypatch.delitem(sys.modules, name)
    result = jbrep(*command.format(collected).split(), "--out", tmp_path / "x")
    message = f"Error: this needs {package}: pip install 'jbrep[{extra}]'\n"
    assert (result.exit_code, result.output) == (2, message)


_MISTAKES = """
import sys
from jbrep.cli import main
main(["--help"], standalone_mode=False)
assert not {"numpy", "torch", "gymnasium", "mujoco", "h5py", "filelock"} & {*sys.modules}
given = (
    "encoder list --task fly",
    "rl --task face_direction --steps -5 --out x", "rl --task fly --out x",
    "rl --task face_direction --algorithm fly --out x",
    "rl --task face_direction --encoder fly --out x", "rl --task face_direction --seed -1 --out x",
    "rl --task face_direction --preset fly --out x", "rl --task face_direction --set a --out x",
    "rl --task face_direction --from nothing --out x",
    "train-encoder --kind fly --data nothing --out x",
    "collect --task fly --steps 10 --out x", "collect --task face_direction --steps -5 --out x",
    "evaluate --encoder dae-8 --data nothing",
    "evaluate-policy nothing", "inspect nothing",
    "study nothing.toml", "report nothing", "encoder info nothing",
    *(f"{each} {300 * 'a'}" for each in ("report", "study", "inspect", "evaluate-policy", "env")),
    f"collect --task face_direction --steps 10 --out {300 * 'a'}",
)
for words in given:
    try:
        main(words.split())
    except SystemExit as ended:
        assert ended.code == 2, words
    assert "torch" not in sys.modules, words
"""


def test_help_and_mistakes_in_words_import_nothing_heavy(tmp_path):
    command = [sys.executable, "-c", _MISTAKES]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Error: ") == done.stderr.count("\n") == 24


@pytest.mark.parametrize(
    ("typed", "begun", "expected"),
    [
        ("collect --task", "move_to", ["move_to_position", "move_to_pose"]),
        ("train-encoder --kind", "linear", ["linear-forward"]),
        ("rl --task move_to_pose --encoder", "sy", ["symmetry"]),
        ("encoder info", "pca-1", ["pca-12"]),
    ],
)
def test_a_shell_completes_tasks_kinds_and_encoders(typed, begun, expected):
    completing = ShellComplete(main, {}, "jbrep", "_JBREP_COMPLETE")
    found = completing.get_completions(typed.split(), begun)
    assert [item.value for item in found] == expected


def test_help_of_a_kind_has_its_settings_alone():
    told = jbrep("train-encoder", "--kind", "slow", "--help").output
    assert "--lags" in told
    assert "--noise" not in told
    assert jbrep("train-dae", "--kind", "pca", "--help").exit_code == 2


class Walk(Record, frozen=True, kw_only=True):
    steps: Annotated[int, Meta(ge=1, le=10_000)]
    length: Annotated[float, Meta(gt=0)] = 0.5
    gait: Literal["trot", "pace"] = "trot"
    start_at: str = field(name="from", default="")
    legs: tuple[int, ...] = ()


def robot(name: str = "bug", mass: Annotated[float, Meta(gt=0)] = 1.0) -> str:
    return f"{name} of {mass} kg"


def walk(
    out: Path,
    name: Annotated[str, Meta(extra={"made_by": robot})],
    *,
    back: Annotated[bool, Meta(description="And home again.")] = False,
    lower: Mapping[str, Any] = {},
    hide: Sequence[str] = (),
    **walk: Annotated[Any, Walk],
) -> int:
    """Walk."""
    print({"out": out, "name": name, "back": back, "lower": lower, "hide": hide, **walk})
    return 3


def follow(leader: str, /, back: bool, **options: Annotated[Any, walk]) -> None:
    print(leader, back, options)


def run(line, function=walk):
    command = Command(function.__name__, function, "walk --out x")
    return CliRunner().invoke(command, line.split(), standalone_mode=False, catch_exceptions=True)


def test_parameters_of_functions_and_fields_of_records_are_options():
    ran = run("--out x --steps 5k --mass 2 --gait pace --from here --legs 1,2 --lower a=1 b=c")
    assert eval(ran.output, {"PosixPath": Path}) == {
        **{"out": Path("x"), "name": "bug of 2.0 kg", "back": False, "lower": {"a": 1, "b": "c"}},
        **{"hide": (), "steps": 5000, "gait": "pace", "start_at": "here", "legs": (1, 2)},
    }
    assert ran.exception.code == 3


def test_a_function_may_take_the_options_of_another():
    ran = run("bug --out x --steps 5 --hide a b --back", follow)
    assert ran.exception is not None  # with an argument, an option takes one value
    ran = run("bug --out x --steps 5 --hide a --hide b --back", follow)
    assert ran.output.startswith(
        "bug True {'out': PosixPath('x'), 'name': 'bug of 1.0 kg', 'hide': ('a', 'b'), "
    )


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("--steps 0", "steps is 0"),
        ("--steps 1 --gait fly", "gait is 'fly': it must be one of pace, trot"),
        ("--steps 1 --mass 0", "mass is '0'"),
        ("--steps 1 --lower a", "lower a isn't an argument"),
    ],
)
def test_the_annotation_says_what_a_value_must_be(given, told):
    error = run(f"--out x {given}").exception
    assert isinstance(error, InputError)
    assert re.search(re.escape(told), str(error))


def test_every_extra_is_examined(monkeypatch):
    monkeypatch.setattr(doctor, "_opengl", lambda: "not tried")
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
    assert set(doctor.extras()) == {*project["optional-dependencies"]}
    text = " ".join(jbrep("doctor").output.split())
    for name in ("numpy", "mujoco", "torch", "pillow"):
        assert f"{name} {version(name)}" in text


def test_a_module_is_known_by_the_extra_that_brings_it():
    modules = ("PIL", "sklearn", "rerun", "torch", "ray", "numpy", "fly")
    extras = ["render", "learn", "view", "learn", "cluster", None, None]
    assert [doctor.extra_with(module) for module in modules] == extras


CORE_ALONE = """
import sys

class Missing:
    def find_spec(self, name, path, target=None):
        if name in missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

folder, *missing = sys.argv[1:]
sys.meta_path.insert(0, Missing())
from jbrep.cli import main
for command in ("collect --task face_direction --steps 1000 --out", "data verify", "data info"):
    try:
        main([*command.split(), folder])
    except SystemExit as ended:
        assert not ended.code, command
"""


def test_without_any_extra_states_are_collected_and_read(tmp_path):
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]

    def distributions(requirements):
        return {canonicalize_name(Requirement(each).name) for each in requirements}

    extras = distributions(chain.from_iterable(project["optional-dependencies"].values()))
    left_out = extras - distributions(project["dependencies"])
    modules = [
        module
        for module, brought_by in packages_distributions().items()
        if {*map(canonicalize_name, brought_by)} <= left_out
    ]
    assert {"torch", "sklearn", "rosbags"} <= {*modules}
    command = [sys.executable, "-c", CORE_ALONE, tmp_path / "data", *modules]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1,000 rows" in done.stdout
