"""Studies: their files, preparation, workers, kills, clusters and results."""

import csv
import json
import os
import shutil
import signal
import threading
import time
import tomllib
from collections import Counter
from contextlib import nullcontext
from pathlib import Path

import gymnasium
import pytest
import robots
from command import in_this_process, jbrep, mistake, workers_of
from gymnasium.envs.classic_control import PendulumEnv
from small import adopt, forge

from jbrep.encoders import load
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.records.record import from_plain, to_plain
from jbrep.reporting.findings import Findings
from jbrep.reporting.tables import read_tables
from jbrep.rl.files import CHECKPOINT, RUN, read_run
from jbrep.rl.presets import ALGORITHMS, get_preset
from jbrep.stats.rules import Rules
from jbrep.studies.config import Data, Study, as_study, read_study
from jbrep.studies.forecast import forecast
from jbrep.studies.plan import PROGRESS, STUDY, Plan
from jbrep.studies.prepare import check, prepare
from jbrep.studies.representations import ByName
from jbrep.studies.runner import on_this_machine, run_study, work
from jbrep.studies.tables import REFERENCE_RETURNS, RETURNS, write_tables

ROOT = Path(__file__).parent.parent
TOML = """
tasks = ["face_direction"]
algorithms = ["a2c-paper"]
representations = ["full", "pca-8"]
seeds = 2
steps = 80
evaluate_every = 80
evaluation_episodes = 1
final_episodes = 2
episode_steps = 20
"""
TINY = as_study(tomllib.loads(TOML))


def tables(folder):
    """The tables of a study, as bytes."""
    write_tables(folder)
    found = Findings.of(read_tables(folder)).as_json()["groups"]
    return (folder / RETURNS).read_bytes(), json.dumps(found).encode()


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The tiny study, finished without workers."""
    plan = Plan(TINY, tmp_path_factory.mktemp("study") / "done")
    assert run_study(plan, in_this_process, 1) == 0
    return plan


@pytest.mark.parametrize(
    "path", sorted((ROOT / "studies").rglob("*.toml")), ids=lambda path: path.stem
)
def test_the_studies_that_come_along_are_studies(path, tmp_path):
    study = read_study(path)
    if path.stem == "paper":
        assert (study.steps, len(study.seeds)) == (5_000_000, 10)
        assert study.data == {"": Data(steps=5_000_000)}
        assert {"dae-12", "dae-8", "dae-4", "full"} <= {*study.representations}
    assert as_study(tomllib.loads(study.toml())) == study
    ready = all(isinstance(each, ByName) for each in study.observed)  # else made by others first
    with nullcontext() if ready else pytest.raises(InputError, match=r"is missing|is code"):
        check(Plan(study, tmp_path / "it"))


def written(folder, *lines):
    """The file of the tiny study with other lines, or more of them."""
    changed = {line.partition(" = ")[0]: line for line in TOML.split("\n") if line}
    changed |= {line.partition(" = ")[0]: line for line in lines}
    (folder / "tiny.toml").write_text("\n".join(changed.values()))
    return folder / "tiny.toml"


def test_a_study_from_toml(tmp_path):
    study = read_study(written(tmp_path))
    assert study == TINY
    assert (study.tasks, study.representations) == (("face_direction",), ("full", "pca-8"))
    assert (study.seeds, study.steps, study.episode_steps) == ((0, 1), 80, 20)
    with pytest.raises(InputError, match=r"none\.toml"):
        read_study(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("line", "field"),
    [
        ("task = 7", "unknown key 'task'"),
        ('tasks = ["fly"]', "unknown task 'fly'"),
        ('tasks = ["Robots/Ant-v0", "Robots-Ant-v0"]', "share a folder"),
        ('algorithms = ["a2c-best"]', "unknown preset .*'best'"),
        ('representations = ["full", "dae-wide-8"]', "unknown representation 'dae-wide-8'"),
        ('representations = ["full", "full"]', "representations"),
        ("seeds = 0", "seeds"),
        ("seeds = [0.5]", "seeds"),
        ("steps = '80'", "steps"),
        ("evaluation_episodes = 5", "final_episodes"),
        ('domain = {delay = "2..0"}', "delay"),
        ("env = {g = inf}", "env"),
        ("data = {rows = 7}", "data.rows"),
        ('data = {folder = "it", sets = 2}', "sets"),
        ("training = {epochs = 3}", "data"),
        ("data = {steps = 9}\ntraining = {latent = 3}", "training.latent"),
        ("steps 80", "TOML"),
    ],
)
def test_a_mistaken_study_is_refused(line, field, tmp_path):
    path = written(tmp_path, line)
    with pytest.raises(InputError, match=field) as error:
        read_study(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_what_a_study_can_not_show_is_said_first(tmp_path, monkeypatch):
    two = TINY.replace(representations=("pca-8", "pca-4"))
    assert two.baseline == "pca-8"
    assert two.replace(verdicts=Rules(baseline="pca-4")).baseline == "pca-4"
    with pytest.raises(InputError, match=r"baseline is 'pca-9'"):
        TINY.replace(verdicts=Rules(baseline="pca-9"))
    assert "exploratory" in TINY.notices[0]
    few = TINY.replace(algorithms=("sac-modern",), seeds=(0,)).notices
    assert few[1].startswith("sac-modern learns from step 1,000 on: ")
    path = written(tmp_path, 'representations = ["full"]')
    monkeypatch.setattr("jbrep.studies.forecast.estimate", lambda run: 60)
    told = jbrep("study", path, "--out", tmp_path / "out", "--dry-run")
    assert "This study compares nothing: it has one" in told.stderr
    assert max(map(len, told.stderr.splitlines())) <= 80


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": {"spring": 1}}, "can't make Pendulum-v1 with {'spring': 1}"),
        (
            {"representations": ("full", "pca-4"), "data": {"": Data(steps=9)}},
            "choose a latent size of at most 3",
        ),
        (
            {"representations": ("full", "pca-2")},
            "no encoder 'pca-2' ships for Pendulum-v1: choose one of full, or let the study train",
        ),
    ],
)
def test_what_the_environment_rules_out_is_said_first(changes, message, tmp_path):
    study = TINY.replace(tasks=("Pendulum-v1",), representations=("full",))
    with pytest.raises(InputError, match=message):
        run_study(Plan(study.replace(**changes), tmp_path / "it"), None, 1)
    assert not (tmp_path / "it").exists()


def test_every_cell_has_its_run(done):
    assert len({cell.name for cell in done.cells}) == 4
    for cell in done.cells:
        settings = read_run(done.folder_of(cell)).settings
        assert (settings.name, settings.algorithm, settings.seed) == (cell.name, "a2c", cell.seed)
        assert not (done.folder_of(cell) / PROGRESS).exists()


def test_what_is_finished_is_not_run_again_and_seeds_may_come(done, tmp_path, monkeypatch):
    grown = Plan(TINY.replace(seeds=(0, 1, 2)), done.folder)
    assert [cell.name for cell in grown.unfinished] == [
        "face_direction/a2c-paper/full/seed-2",
        "face_direction/a2c-paper/pca-8/seed-2",
    ]
    before = {p: p.stat().st_mtime_ns for p in (done.folder / "runs").rglob("*.*")}
    assert run_study(done, None, 1) == 0  # nothing is left to run
    assert {p: p.stat().st_mtime_ns for p in (done.folder / "runs").rglob("*.*")} == before
    other = Plan(TINY.replace(steps=90), done.folder)
    for use in (lambda: run_study(other, None, 1), lambda: forecast(other)):
        with pytest.raises(InputError, match=r"another study: steps 80 \(now: 90\)"):
            use()


def test_a_study_that_is_refused_changes_nothing(done, tmp_path):
    """Here by a run of the folder that is another."""
    folder = shutil.copytree(done.folder, tmp_path / "it")
    before = (folder / STUDY).read_bytes()
    run = folder / "runs/face_direction/a2c-paper/full/seed-0/run.json"
    shutil.copy(folder / "runs/face_direction/a2c-paper/full/seed-1/run.json", run)
    with pytest.raises(InputError, match="seed-0"):
        run_study(Plan(TINY.replace(seeds=(0, 1, 2)), folder), None, 1)
    assert (folder / STUDY).read_bytes() == before


def test_it_makes_data_and_encoders(tmp_path):
    study = TINY.replace(
        tasks=("Pendulum-v1", "face_direction", "move_to_pose"),
        representations=("full", "dae-2", "random-1"),
        data={"": Data(steps=200, seed=5)},
        training={"epochs": 1},
    )
    plan = Plan(study, tmp_path / "made")
    plan.write()
    prepare(plan)
    prints = set()
    for cell in plan.cells:
        encoder = load(Path(plan.run(cell).encoder))
        assert encoder.task == plan.study.task(cell.task)
        assert encoder.header.data["seed"] == 5
        prints.add((cell.task, encoder.header.data["fingerprint"]))
        plan.run(cell).check()
    assert len(prints) == 3
    stamp = {p: p.stat().st_mtime_ns for p in plan.folder.rglob("*.safetensors")}
    assert len(stamp) == 9
    prepare(plan)
    assert {p: p.stat().st_mtime_ns for p in stamp} == stamp


def test_a_data_set_from_elsewhere(collected, tmp_path):
    for folder in (collected, collected.parent):
        study = TINY.replace(data={"": Data(folder=str(folder))})
        plan = Plan(study, tmp_path / folder.name)
        prepare(plan)
        assert (plan.encoders("face_direction") / "pca-8.safetensors").exists()
    five = {"representations": ("full", "pca-5"), "data": None}
    for changes, message in (
        ({"representations": ("full", "pca-17")}, "pca-17 can't be trained for face_direction: la"),
        ({"representations": ("full", "pca-99")}, "latent size is 99"),
        (five, r"no encoder 'pca-5' ships for .*: choose one of coordinates, dae-12"),
        (
            {"tasks": ("move_to_pose",), "data": {"": Data(folder=str(collected))}},
            "made for face_direc",
        ),
    ):
        with pytest.raises(InputError, match=message):
            run_study(Plan(study.replace(**changes), tmp_path / "wrong"), None, 1)
    assert not (tmp_path / "wrong").exists()


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # of infinite returns
def test_a_failed_run_and_a_crashed_one_stop_no_other(tmp_path, monkeypatch):
    preset = get_preset("paper", "a2c")
    wild = preset.replace(algorithm_kwargs={**preset.algorithm_kwargs, "learning_rate": 1e30})
    monkeypatch.setitem(ALGORITHMS["a2c"].presets, "modern", wild)
    study = TINY.replace(algorithms=("a2c-paper", "a2c-modern"))
    plan = Plan(study, tmp_path / "mixed")
    blocked = plan.folder_of(plan.cells[0])
    blocked.mkdir(parents=True)
    (blocked / "encoder.safetensors").mkdir()  # in the place of a file
    assert run_study(plan, in_this_process, 1) == 1
    assert "can't write" in (blocked / "error.txt").read_text()
    statuses = {cell.name: read_run(plan.folder_of(cell)).status for cell in plan.cells[1:]}
    for name, status in statuses.items():
        assert status == ("failed" if "a2c-modern" in name else "finished")
    (blocked / "encoder.safetensors").rmdir()
    assert run_study(plan, in_this_process, 1) == 0
    write_tables(plan.folder)
    analysis = read_tables(plan.folder).analysis
    failed = {group.algorithm: [len(x.failed) for x in group.labels] for group in analysis.groups}
    assert failed == {"a2c-paper": [0, 0], "a2c-modern": [2, 2]}


@pytest.mark.usefixtures("one_figure")
def test_a_stopped_study_is_resumed(done, tmp_path, monkeypatch):
    """And reported before."""
    plan, out = Plan(TINY, tmp_path / "stopped"), tmp_path / "stopped"
    plan.write()
    finished, begun, *_ = plan.cells
    with monkeypatch.context() as patch:
        stop = iter((False, True)).__next__  # after its first rollout
        patch.setattr("jbrep.studies.runner.stop_requested", stop)
        assert work(plan.assigned(begun)) is None
    assert (plan.folder_of(begun) / CHECKPOINT).exists()
    assert f"no finished run below {out}" in mistake("report", out)
    shutil.copytree(done.folder_of(finished), plan.folder_of(finished))
    reported = jbrep("report", out, "--json")
    assert reported.exit_code == 0, reported.output
    found = json.loads(reported.stdout)
    assert found == json.loads((out / "findings.json").read_text())
    assert (len(found["missing"]), len(found["runs"])) == (3, 1)
    assert run_study(plan, in_this_process, 1) == 0
    assert tables(out) == tables(done.folder)


def test_crashed_runs_are_told_at_the_end(done, tmp_path, monkeypatch):
    path = written(tmp_path)
    out = shutil.copytree(done.folder, tmp_path / "out")
    shutil.rmtree(Plan(TINY, out).folder_of(done.cells[0]))
    monkeypatch.setattr("jbrep.studies.run_study", lambda *given: 1)
    monkeypatch.setattr("jbrep.reporting.report.write_report", lambda found, out: [out])
    told = jbrep("study", path, "--out", out)
    assert told.exit_code == 1
    assert "Note: 1 run crashed: run the study again to retry\n" in told.stderr


MIXED = (
    'tasks = ["Robots/Pendulum-v1", "face_direction"]',
    'representations = ["full", "dae-2"]',
    "data = {steps = 200}",
    "training = {epochs = 1}",
)


@pytest.mark.slow  # tests/test_pool.py kills workers in seconds
@pytest.mark.usefixtures("one_figure")
def test_two_workers_of_which_one_is_killed_make_the_same(tmp_path, monkeypatch):
    """They import a robot's package; the report is made where that is missing."""
    path, out = written(tmp_path, *MIXED), tmp_path / "mixed"
    plan, killed = Plan(read_study(path), out), []
    plan.write()
    prepare(plan)

    def kill():
        while not list(out.rglob(PROGRESS)):
            time.sleep(0.02)
        killed.append(workers_of(os.getpid())[-1])
        os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    with monkeypatch.context() as once:
        once.setattr("jbrep.reporting.report.write_report", lambda found, out: [out])
        told = jbrep("study", path, "--out", out, "--workers", 2, "--import", "robots")
    assert told.exit_code == 0, told.output
    killer.join(60)
    assert killed
    peace = Plan(read_study(path), tmp_path / "peace")
    assert run_study(peace, in_this_process, 1) == 0
    assert tables(out) == tables(peace.folder)
    monkeypatch.delitem(gymnasium.registry, robots.ID)
    told = jbrep("report", out)
    assert told.exit_code == 0, told.output
    assert f"{robots.ID}/a2c-paper/dae-2" in (out / "report.html").read_text()
    found = json.loads((out / "findings.json").read_text())
    assert (len(found["runs"]), found["missing"]) == (8, {})
    returns = {task: [] for task in (robots.ID, "face_direction")}
    for task, _, _, _, _, _, each in list(csv.reader((out / RETURNS).read_text().splitlines()))[1:]:
        returns[task].append(float(each))
    assert {len(each) for each in returns.values()} == {2 * 2 * (1 + 2)}
    assert max(returns[robots.ID]) < 0 <= min(returns["face_direction"])
    assert max(returns["face_direction"]) <= 20
    played = [line.split(",")[0] for line in (out / REFERENCE_RETURNS).read_text().splitlines()]
    assert Counter(played) == {"task": 1, "face_direction": 4 * 2, robots.ID: 3 * 2}
    folders = {folder.name for folder in (out / "runs").iterdir()}
    assert folders == {"Robots-Pendulum-v1", "face_direction"}
    refused = jbrep("study", path, "--out", out)
    assert "unknown task 'Robots/Pendulum-v1'" in refused.stderr
    assert "--import it first" in refused.stderr  # its file names no module


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("evaluations.csv", "step,episode,return\n0,0", "damaged or cut short"),
        ("evaluations.csv", "step,episode,return\n0,0,nan\n80,0,1\n", "damaged or cut short"),
        (RUN, "[]", "damaged, or not a jbrep run file"),
        (RUN, "settings", r"settings\.\w+ is missing"),
    ],
)
def test_a_damaged_run_is_named(name, content, message, done, tmp_path):
    source = done.folder_of(done.cells[0])
    for each in (RUN, "evaluations.csv"):
        (tmp_path / each).write_bytes((source / each).read_bytes())
    if content == "settings":
        record = json.loads((tmp_path / RUN).read_text())
        forge(tmp_path / RUN, {**record, "settings": {}})
    else:
        (tmp_path / name).write_text(content)
    if name != RUN:
        adopt(tmp_path / RUN, name)
    with pytest.raises(InputError, match=message):
        write_tables(tmp_path)


def test_what_a_run_killed_at_its_very_end_left_is_removed(done):
    left = done.folder / "runs" / "face_direction" / "a2c-paper" / "full" / "seed-0" / CHECKPOINT
    left.write_bytes(b"left")
    run_study(done, on_this_machine, 1)
    assert not left.exists()


def test_a_task_is_described_in_a_study_as_everywhere(tmp_path):
    features = tmp_path / "features.toml"
    features.write_text("timestep = 0.5\n" + "[[features]]\nunit = 'm'\n" * 3)
    file = written(
        tmp_path,
        'tasks = ["Pendulum-v1", {task = "Pendulum-v1", name = "moon", env = {g = 1.6}, '
        'action_bounds = "-1..1", hide = ["obs_2"], episode_steps = 9}]',
        "history = 3",
        f'features = "{features}"',
    )
    study = read_study(file)
    plain, moon = study.task("Pendulum-v1"), study.task("moon")
    expected = describe(
        *("Pendulum-v1", {"g": 1.6}, 9, features), hide=["obs_2"], history=3, action_bounds=(-1, 1)
    )
    assert moon == expected.replace(name="moon")
    assert (plain.view.history, plain.timestep, plain.action_high) == (3, 0.5, (2.0,))
    features.unlink()  # the study has what it held
    assert as_study(tomllib.loads(study.toml())) == study
    assert from_plain(to_plain(study), Study) == study
    assert {cell.task for cell in Plan(study, tmp_path).cells} == {"Pendulum-v1", "moon"}
    other = as_study(tomllib.loads(study.toml()) | {"history": 2, "tasks": ["Pendulum-v1"]})
    Plan(study, tmp_path / "it").write()
    with pytest.raises(InputError, match=r"tasks\.Pendulum-v1\.history 3 \(now: 2\)"):
        Plan(other, tmp_path / "it").check_folder()


def test_a_tasks_own_arguments_are_beside_those_of_all(tmp_path):
    file = written(
        tmp_path,
        'tasks = ["Hopper-v5", {task = "Hopper-v5", name = "own", '
        "env = {reset_noise_scale = 0.1}, domain = {noise = 0.2}}]",
        "env = {frame_skip = 2}",
        "domain = {delay = 1}",
    )
    task = read_study(file).task("own")
    assert task.arguments == {"frame_skip": 2, "reset_noise_scale": 0.1}
    assert (task.domain.delay, task.domain.noise) == ((1, 1), (0.2, 0.2))


def test_an_instance_is_refused_before_a_study_begins(tmp_path):
    class Own(PendulumEnv):
        pass

    task = describe(Own(), episode_steps=20)
    study = TINY.replace(tasks=(task.id,), representations=("full",), episode_steps=20)
    with pytest.raises(InputError, match="exists in this process alone"):
        check(Plan(study, tmp_path))
