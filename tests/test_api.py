"""jbrep from Python: functions with the words of the commands."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from click.testing import CliRunner
from command import in_this_process

import jbrep
from jbrep.cli import main
from jbrep.envs.names import Known
from jbrep.errors import InputError, Notice
from jbrep.rl.policy_file import find_shipped as find
from jbrep.studies.runner import BACKENDS

QUICK = {"steps": 64, "evaluate_every": 64, "evaluation_episodes": 1, "final_episodes": 3}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with data and two encoders of them."""
    folder = tmp_path_factory.mktemp("home")
    task = jbrep.describe("face_direction", episode_steps=40)
    data = jbrep.collect(task, folder / "data", 400, seed=3)
    assert len(data) == 400
    jbrep.train_encoder(data, folder / "encoders", "pca", latent=4)
    return folder


def test_from_states_to_a_policy(home):
    data = jbrep.Dataset(home / "data")
    encoder = jbrep.train_encoder(home / "data", home / "encoders", "pca", latent=4)
    assert (encoder.name, encoder.latent_size) == ("pca-4", 4)
    agent = jbrep.train(data.task, home / "run", algorithm="a2c", encoder=encoder, **QUICK)
    assert agent.returns.shape == (3,)
    assert repr(agent).startswith("Agent(a2c-modern on pca-4, face_direction: ")
    assert repr(agent).endswith(f"mean and 95 % interval of 3 episodes; '{home}/run')")
    policy = jbrep.load_policy(home / "run")
    row = data["observation"][0]
    np.testing.assert_array_equal(policy(row), agent.policy(row))


def test_what_is_too_short_to_learn_or_not_to_be_written_is_told_first(home, tmp_path, monkeypatch):
    task = jbrep.Dataset(home / "data").task
    with pytest.warns(Notice, match="sac-modern learns from step 1,000 on: nothing is learned"):
        jbrep.train(
            task, tmp_path / "a", **QUICK | {"steps": 256, "evaluate_every": 256}, preset="modern"
        )
    monkeypatch.setattr("jbrep.play.sources.find_good_policy", None)  # plays thirty episodes
    (tmp_path / "junk").mkdir()
    (tmp_path / "junk/a.txt").touch()
    with pytest.raises(InputError, match="junk holds other things, such as a"):
        jbrep.evaluate("pca-8", home / "data", tmp_path / "junk")
    with pytest.raises(InputError, match="shows nothing that"):
        jbrep.evaluate("pca-8", home / "data", tmp_path / "out", truth=home / "data")
    assert not (tmp_path / "out").exists()


def test_several_encoders_are_made_when_they_are_asked_for(home):
    out = home / "several"
    mistake = {"latent": [2, 99], "seeds": 2}
    with pytest.raises(InputError, match="latent size is 99: with 16 features it must"):
        jbrep.train_encoders(home / "data", out, "random", **mistake)
    made = jbrep.train_encoders(home / "data", out, "random", latent=[2, 3], seeds=2)
    assert not out.exists()
    assert [each.encoder.name for each in made] == [
        *("random-2-s0", "random-2-s1", "random-3-s0", "random-3-s1")
    ]
    (some,) = jbrep.train_encoders(home / "data", out, "subset", features="velocity_*")
    assert some.encoder.name == "subset-3"
    (again,) = jbrep.train_encoders(home / "data", home / "encoders", "pca", latent=[4])
    assert str(again).startswith("pca-4: reconstructs held-out states with a mean squared error of")
    assert str(again).endswith("pca-4.safetensors, already complete")


def test_encoders_are_judged_by_names_and_as_a_dictionary(home):
    path = home / "encoders/pca-4.safetensors"
    by_name = jbrep.evaluate([path, lambda rows: rows[:, :2]], home / "data")
    assert [*by_name.encoders] == ["full", "pca-4", "function"]
    assert "\npca-4        4 " in repr(by_name)
    named = jbrep.evaluate({"mine": path}, jbrep.Dataset(home / "data"), home / "evaluation")
    assert (home / "evaluation/evaluation.json").exists()
    assert named.encoders["mine"].reconstruction == by_name.encoders["pca-4"].reconstruction
    with pytest.raises(InputError, match="pca-4 is given twice: leave one out, or, in Python"):
        jbrep.evaluate([path, path], home / "data")


@pytest.mark.usefixtures("one_figure")
def test_a_study_without_a_file(home, monkeypatch):
    monkeypatch.setitem(BACKENDS, "local", in_this_process)
    study = jbrep.Study(
        tasks=("Pendulum-v1",),
        episode_steps=20,
        algorithms=("a2c-modern",),
        representations=("full",),
        seeds=(0, 1),
        **QUICK,
    )
    with pytest.warns(Notice, match="This study compares nothing: it has one"):
        found = jbrep.study(study, home / "study", workers=1)
    assert {row.seed for row in found.returns} == {0, 1}
    assert found.page.exists()
    assert "Pendulum-v1" in repr(found)
    again = jbrep.report(home / "study", out=home / "elsewhere")
    assert again.page == home / "elsewhere/report.html"
    assert again.returns == found.returns


def test_importing_jbrep_imports_nothing_heavy():
    code = (
        "import sys, jbrep; assert not {'torch', 'numpy', 'gymnasium'} & {*sys.modules};"
        "assert {*jbrep.__all__} <= {*dir(jbrep)} and jbrep.__version__;"
        f"jbrep.load_policy({str(find(jbrep.describe('face_direction')))!r});"
        "assert 'torch' not in sys.modules;"
        "import jbrep.collecting.shards, jbrep.studies.config;"
        "from jbrep import report; print({type(report), type(jbrep.study), type(jbrep.collect)})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "{<class 'function'>}\n"
    for name in jbrep.__all__:
        assert callable(getattr(jbrep, name))


def test_a_command_and_its_function_write_the_same_bytes(home, tmp_path):
    given = "collect --task face_direction --episode-steps 40 --steps 400 --seed 3"
    arguments = [*given.split(), "--out", str(tmp_path / "data")]
    CliRunner().invoke(main, arguments, catch_exceptions=False)
    (shard,) = (tmp_path / "data").glob("*.h5")
    assert shard.read_bytes() == (home / "data" / shard.name).read_bytes()


def test_python_speaks_of_its_own_arguments_and_leaves_warnings_alone(home, tmp_path, monkeypatch):
    before = [*warnings.filters]
    monkeypatch.setattr("jbrep.play.sources.find_good_policy", lambda *given: None)
    jbrep.evaluate(lambda rows: rows[:, :2], home / "data")
    assert warnings.filters == before
    with pytest.raises(InputError, match=r"overrides=\{'learning_rate': \.\.\.\}"):
        jbrep.train("Pendulum-v1", tmp_path / "run", learning_rate=1e-3)
    with pytest.raises(InputError, match="`import` it first"):
        jbrep.describe("CartPendd-v0")


def test_a_project_remembers_what_it_imports(tmp_path, monkeypatch):
    deep = tmp_path / "project/deep"
    (deep / ".git").mkdir(parents=True)
    (tmp_path / "mybots_a.py").write_text("import environments")
    (tmp_path / "mybots_b.py").write_text("import environments")
    (tmp_path / "pyproject.toml").write_text("[tool.jbrep]\nimport = ['mybots_a']")
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    monkeypatch.setattr("sys.path", [*sys.path])

    def imports(where):
        monkeypatch.chdir(where)
        CliRunner().invoke(main, ["env", "no-such-task"])
        return Known.of([]).modules

    assert imports(deep) == ()  # a repository of its own
    (deep / ".git").rename(tmp_path / ".git")
    monkeypatch.setenv("JBREP_IMPORT", "mybots_b")
    assert imports(deep) == ("mybots_a", "mybots_b")
    for nothing in ("[tool]\njbrep = 3", "tool = 3"):
        (tmp_path / "pyproject.toml").write_text(nothing)
        assert imports(deep) == ("mybots_a", "mybots_b")
    (tmp_path / "pyproject.toml").write_text("[tool.jbrep]\nimport = 7")
    told = CliRunner().invoke(main, ["env", "Pendulum-v1"])
    assert (told.exit_code, "import in [tool.jbrep]" in told.output) == (2, True)
