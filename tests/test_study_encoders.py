"""Users' own encoders in studies and runs: files, code and objects."""

import json
import shutil
import tomllib
from pathlib import Path

import onnx
import pytest
from command import in_this_process, jbrep
from judged import diagnostics, evaluation
from my_encoders import LATENT, SIZE, FirstFeatures, dense
from small import ONE_EACH, forge
from test_convert import model
from test_study import TINY as TINY_STUDY

from jbrep.encoders import find, load, save
from jbrep.envs import describe
from jbrep.envs.names import import_modules
from jbrep.errors import DamageError, InputError
from jbrep.evaluation.evaluation import EVALUATION, Score
from jbrep.evaluation.table import DIAGNOSTICS, read_diagnostics
from jbrep.records.record import to_plain
from jbrep.reporting.diagnostics import add_diagnostics
from jbrep.reporting.findings import Findings
from jbrep.reporting.report import commands
from jbrep.reporting.tables import read_tables
from jbrep.reporting.views import settings_tables
from jbrep.rl import Run, Session, StoppedError, train
from jbrep.rl.files import ENCODER, read_run
from jbrep.rl.policy import load_run
from jbrep.studies.config import Data, as_study
from jbrep.studies.plan import Plan, read_plan
from jbrep.studies.prepare import prepare
from jbrep.studies.record import EACH_ITS_OWN, RECORD
from jbrep.studies.runner import run_study
from jbrep.studies.tables import write_tables

TASK = "face_direction"
NET = "my_encoders:Net"
SHARED = {"task": describe(TASK, {}, 50), "algorithm": "a2c", "preset": "paper", **ONE_EACH}
SHARED |= {"steps": 80, "evaluate_every": 80}
TINY = TINY_STUDY.replace(representations=("full",), episode_steps=50)


def with_own(*own, **changes):
    """The tiny study with other encoders beside the whole observation."""
    return TINY.replace(representations=("full", *own), **changes)


def put(name, path):
    """Keep a shipped encoder as a file of the user's."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save(find(name, TASK), path)
    return path


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A working directory with the user's encoders."""
    import_modules(["my_encoders"])
    folder = tmp_path_factory.mktemp("home")
    for seed, name in enumerate(("pca-8", "random-8")):
        put(name, folder / "encoders" / TASK / f"mine-{seed}.safetensors")
    write_onnx(dense(), folder / "net.onnx")
    options = ("--task", TASK, "--out", folder / "from-onnx.safetensors")
    told = jbrep("encoder", "import", folder / "net.onnx", *options)
    assert told.exit_code == 0, told.output
    return folder


@pytest.fixture(autouse=True)
def at_home(home, monkeypatch):
    monkeypatch.chdir(home)


def write_onnx(net, path):
    """Write two layers with a tanh between them as an ONNX model."""
    nodes = "h = Gemm observation w0 b0; t = Tanh h; y = Gemm t w1 b1"
    weights = {
        f"{name}{i}": values.detach().numpy().T
        for i, layer in enumerate((net[0], net[2]))
        for name, values in (("w", layer.weight), ("b", layer.bias))
    }
    onnx.save(model(nodes, weights, ("observation", ("rows", SIZE))), path)


PATTERN = {"name": "mine", "file": "encoders/{task}/mine-{seed}.safetensors"}
CODE = {"name": "net", "code": NET}
DENSE = {"name": "dense", "code": "my_encoders:dense"}
OWN = {each["name"]: each["code"] for each in (CODE, DENSE)}
FROM_ONNX = {"name": "from-onnx", "file": "from-onnx.safetensors"}


@pytest.fixture(scope="module")
def done(home):
    """A study of files and code, finished."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        plan = Plan(with_own(PATTERN, CODE, DENSE, FROM_ONNX), home / "done")
        assert run_study(plan, in_this_process, 1) == 0
        write_tables(plan.folder)
    return plan


def test_each_run_has_its_encoder(done):
    for cell in done.cells:
        folder, name = done.folder_of(cell), cell.representation.name
        settings = read_run(folder).settings
        assert settings.representation == name
        assert settings.encoder_seed == (cell.seed if name == "mine" else None)
        assert settings.encoder_code == OWN.get(name)
        assert (folder / ENCODER).exists() == (name not in OWN)
        if name == "mine":
            assert load(folder / ENCODER).name == ("pca-8", "random-8")[cell.seed]
            assert load_run(folder).representation == "mine"


def test_runs_with_an_encoder_each_stand_under_one_label(done):
    results = read_tables(done.folder)
    assert not results.left_out
    (group,) = results.analysis.groups
    assert [(label.representation, label.seeds) for label in group.labels] == [
        (name, (0, 1)) for name in ("full", "dense", "from-onnx", "mine", "net")
    ]
    record = json.loads((done.folder / RECORD).read_text())
    mine, net = (record["labels"][f"{TASK}/a2c-paper/{name}"] for name in ("mine", "net"))
    assert mine["settings"]["encoder"] == EACH_ITS_OWN
    assert (mine["encoder"]["latent_size"], mine["encoder"]["metrics"]) == (8, {})
    assert (net["encoder"]["name"], net["encoder"]["latent_size"]) == (NET, LATENT)
    own = [run for run in record["runs"] if run["label"].endswith("mine")]
    assert len({run["encoder"] for run in own}) == 2
    assert [run["encoder_seed"] for run in own] == [0, 1]


def test_diagnostics_are_matched_by_the_encoders(done, tmp_path):
    shas = {}
    for cell in done.cells:
        run = read_run(done.folder_of(cell)).settings
        shas.setdefault(cell.representation.name, []).append(run.encoder)
    folder = tmp_path / "tables"
    folder.mkdir()
    shutil.copy(done.folder / RECORD, folder)
    assert add_diagnostics(folder) == []
    assert not (folder / DIAGNOSTICS).exists()
    write_evaluation(tmp_path / TASK, {"x": (shas["mine"][1], 0.5), "full": (None, 0.75)})
    lines = add_diagnostics(folder, [str(tmp_path / "{task}")])
    assert lines == [
        f"no diagnostics for {TASK} of dense, from-onnx, mine (1 of 2 encoders), net: evaluate "
        "them, then jbrep report --evaluation"
    ]
    rows = read_diagnostics(folder / DIAGNOSTICS)
    assert [(r.task, r.representation, r.sha256, r.values["forward"]) for r in rows] == [
        (TASK, "full", shas["full"][0], 0.75),
        (TASK, "mine", shas["mine"][1], 0.5),
    ]
    again = {"a": (shas["mine"][0], 0.25), "b": (shas["mine"][1], 0.125)}
    write_evaluation(tmp_path / "later", again)
    shutil.rmtree(tmp_path / TASK)  # what is in the table stays there
    lines = add_diagnostics(folder, [str(tmp_path / "later")])
    assert lines[0].startswith(f"no diagnostics for {TASK} of dense, from-onnx, net: ")
    rows = read_diagnostics(folder / DIAGNOSTICS)
    assert [row.values["forward"] for row in rows] == [0.75, 0.25, 0.125]
    assert add_diagnostics(folder) == lines
    with pytest.raises(InputError, match=r"no evaluation in .*none: jbrep evaluate makes one"):
        add_diagnostics(folder, [str(tmp_path / "none")])
    damaged = tmp_path / "later" / EVALUATION
    damaged.write_text(damaged.read_text().replace("0.25", '"many"'))
    with pytest.raises(DamageError, match="scores"):
        add_diagnostics(folder, [str(tmp_path / "later")])


def write_evaluation(folder, forward):
    """An evaluation of encoders, by label: their SHA-256, and one number."""
    folder.mkdir()
    encoders = {
        label: diagnostics(scores={"forward": Score(each)}, sha256=sha)
        for label, (sha, each) in forward.items()
    }
    evaluation(encoders, TASK).write(folder / EVALUATION)


def test_a_study_names_evaluations(done, tmp_path):
    study = with_own(evaluations=("results/{task}", "e"))
    Plan(study, tmp_path / "study").write()
    assert read_plan(tmp_path / "study").study == study
    contents = json.loads((done.folder / RECORD).read_text())
    contents["study"]["evaluations"] = [str(tmp_path / "{task}"), "nowhere"]
    forge(tmp_path / RECORD, contents)
    write_evaluation(tmp_path / TASK, {"full": (None, 0.75)})
    (line,) = add_diagnostics(tmp_path)
    assert " of dense, from-onnx, mine (2 of 2 encoders), net: " in line
    assert [row.representation for row in read_diagnostics(tmp_path / DIAGNOSTICS)] == ["full"]


def test_evaluations_that_a_study_makes_are_found(done, tmp_path):
    forge(tmp_path / RECORD, json.loads((done.folder / RECORD).read_text()))
    assert add_diagnostics(tmp_path) == []
    (tmp_path / "evaluations").mkdir()
    write_evaluation(tmp_path / "evaluations" / TASK, {"full": (None, 0.75)})
    add_diagnostics(tmp_path)
    assert [row.representation for row in read_diagnostics(tmp_path / DIAGNOSTICS)] == ["full"]


def test_the_report_tells_of_own_encoders(done):
    found = Findings.of(read_tables(done.folder))
    assert found.own_encoders == ["mine"]
    rows = {row[0].rpartition("/")[2]: row[1:] for row in settings_tables(found)[1].rows}
    assert rows["mine"][-1] == EACH_ITS_OWN
    assert rows["net"][:4] == (NET, f"{SIZE} - {LATENT}", "-", "-")
    toml, command = [*commands(found).values()][1:3]
    assert as_study(tomllib.loads(toml)) == done.study
    assert command == "jbrep study study.toml --out done --import my_encoders"
    assert read_plan(done.folder).study == done.study


def test_a_file_that_changes_is_refused_once_its_run_has_ended(done, home):
    path = home / "encoders" / TASK / "mine-1.safetensors"
    before = path.read_bytes()
    try:
        put("pca-4", path)
        with pytest.raises(InputError, match=r"mine/seed-1 holds another run: encoder ") as error:
            run_study(done, None, 1)
        assert "\n" not in str(error.value)
    finally:
        path.write_bytes(before)
    assert run_study(done, None, 1) == 0  # nothing is left to run


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("one.safetensors", "one.safetensors"),
        ("{task}/{seed}.safetensors", f"{TASK}/1.safetensors"),
    ],
)
def test_where_a_file_is(file, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    put("pca-8", tmp_path / expected)
    study = with_own({"name": "mine", "file": file}, seeds=(1,))
    run = Plan(study, tmp_path / "it").run(Plan(study, tmp_path / "it").cells[1])
    assert run.encoder == str(tmp_path / expected)
    assert run.encoder_seed == (1 if "{seed}" in file else None)
    run.check()


def test_encoders_nested_in_one_representation(tmp_path, collected):
    nested = {"name": "random-4", "encoders": 2}
    files = {"name": "mine", "file": "encoders/{task}/mine-{encoder}.safetensors", "encoders": 2}
    own = {"name": "late-4", "kind": "slow", "latent": 4, "lags": [20]}
    data = {"": Data(folder=str(collected))}
    study = with_own(nested, files, own, seeds=(0, 1, 2, 3, 4), data=data)
    assert study.notices[:2] == [
        f"5 seeds share the 2 encoders of {name} unevenly." for name in ("random-4", "mine")
    ]
    plan = Plan(study, tmp_path / "it")
    prepare(plan)
    made = {path.stem: load(path) for path in plan.encoders(TASK).glob("*.safetensors")}
    assert sorted(made) == ["full", "late-4", "random-4-s0", "random-4-s1"]
    assert made["random-4-s1"].header.training["seed"] == 1
    assert made["late-4"].header.training["lags"] == [20]
    runs = {(cell.representation.name, cell.seed): plan.run(cell) for cell in plan.cells}
    told = [(Path(r.encoder).stem, r.representation, r.encoder_seed) for r in runs.values()]
    assert told[1:4] == [
        ("random-4-s0", "random-4", 0),
        ("mine-0", "mine", 0),
        ("late-4", "late-4", None),
    ]
    assert told[5:7] == [("random-4-s1", "random-4", 1), ("mine-1", "mine", 1)]
    assert told[9:11] == told[1:3]
    assert runs["late-4", 0].find_encoder().name == "late-4"
    (exploratory,) = study.replace(seeds=(0, 1)).notices
    assert exploratory.startswith("This study is exploratory")


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (
            {"name": "m", "file": "encoders/{task}/m-{seed}.safetensors"},
            rf"run {TASK}/a2c-paper/m/seed-0 can't start: its encoder .*/{TASK}/m-0.safetensors is",
        ),
        ({"name": "m", "file": "pose.safetensors"}, f"made for move_to_pose, not for {TASK}"),
        ({"name": "m", "code": "other:Net"}, "importing other runs it; .*import.* other"),
        ({"name": "m", "code": "my_encoders:Unseeded"}, "makes another encoder each time"),
    ],
)
def test_own_encoders_are_checked_before_the_first_run(own, message, home, tmp_path):
    save(find("pca-8", "move_to_pose"), home / "pose.safetensors")
    with pytest.raises(InputError, match=message) as error:
        run_study(Plan(with_own(own), tmp_path / "it"), None, 1)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "it").exists()


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ([{"name": "dae-8", "file": "x"}, "dae-8"], "each once"),
        ([7], r"representations\[0\]"),
        ([{"name": "a/b", "file": "x"}], "name"),
        ([{"name": "a", "noise": 0.2, "encoders": 2}], "a: .* file, code, kind"),
        ([{"name": "a", "file": "x", "code": NET}], "a: unknown code"),
        ([{"name": "a", "code": NET, "encoders": 2}], "encoders"),
        ([{"name": "a", "file": ""}], "a: file"),
        ([{"name": "a", "file": "{sed}"}], r"\{sed\}"),
        ([{"name": "a", "code": "Net"}], "a: .*code"),
        ([{"name": "dae-8", "encoders": 1001}], "dae-8: encoders"),
        ([{"name": "slow-8", "encoders": 2}], "slow-8: slow has no seed"),
        ([{"name": "a", "kind": "dae", "latent": 8, "seed": 1, "encoders": 2}], "a: .* seed"),
        ([{"name": "a", "file": "{encoder}"}], r"encoders = "),
        ([{"name": "a", "kind": "fly"}], "a: unknown kind 'fly'"),
        ([{"name": "a", "kind": "slow", "latent": 8, "noise": 1}], "a: slow takes no noise"),
    ],
)
def test_a_mistaken_representation_is_refused(given, field):
    with pytest.raises(InputError, match=field) as error:
        as_study({**to_plain(TINY), "data": {"steps": 9, "sets": 1}, "representations": given})
    assert "\n" not in str(error.value)


def test_a_run_on_code(done, tmp_path, monkeypatch):
    out = tmp_path / "run"
    options = ("--task", TASK, "--episode-steps", 50, "--algorithm", "a2c", "--steps", 80)
    options += ("--evaluate-every", 80, "--final-episodes", 1, "--evaluation-episodes", 1)
    options += ("--encoder",)
    told = jbrep("rl", *options, NET, "--out", out)
    assert told.exit_code == 0, told.output
    assert f"encoder: {NET}, code" in told.stdout
    with monkeypatch.context() as patch:
        patch.setattr("jbrep.envs.names._imported", [])
        with pytest.raises(InputError, match=f"{NET} is code: importing my_encoders runs it"):
            load_run(out)
    trained = load_run(out, find(NET, TASK))
    assert (trained.representation, trained.encoder.latent_size) == ("Net", LATENT)
    told = jbrep("rl", *options, NET, "--from", out, "--out", tmp_path / "next")
    assert told.exit_code == 0, told.output
    told = jbrep("rl", *options, "full", "--from", out, "--out", tmp_path / "full")
    assert told.exit_code == 2
    assert f"latent {LATENT} (now: {SIZE})" in told.stderr


def test_a_run_on_an_object_resumes_with_the_same_object_alone(tmp_path):
    asked = iter([False, True])
    run = Run.of(encoder=FirstFeatures(), **SHARED)
    with pytest.raises(StoppedError):
        train(run, tmp_path, Session(stop=lambda: next(asked)))
    with pytest.raises(InputError, match="holds another run: encoder"):
        train(Run.of(encoder=FirstFeatures(-1), **SHARED), tmp_path)
    result = train(run, tmp_path)
    assert result.settings.representation == "FirstFeatures"
    with pytest.raises(InputError, match="a run on a Python object needs it again"):
        load_run(tmp_path)
    assert not (tmp_path / ENCODER).exists()
