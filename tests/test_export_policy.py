"""Policies as files for a robot: they act as the runs that they were taken from."""

import json
import runpy

import numpy as np
import onnxruntime
import pytest
from command import jbrep, mistake
from test_controller import controller_of, difference_over_an_episode, randomised

from jbrep.envs.description import describe
from jbrep.errors import InputError
from jbrep.rl import Run, train
from jbrep.rl.controller import EXAMPLE, described, export

KINDS = [("sac", "symmetry"), ("ppo", "coordinates"), ("td3", "dae-8"), ("crossq", "full")]


@pytest.mark.parametrize(("algorithm", "encoder"), KINDS)
def test_an_exported_policy_acts_as_its_run(algorithm, encoder, tmp_path):
    trained = randomised(algorithm, encoder)
    controller = controller_of(trained)
    export(controller, tmp_path / "it.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    said = json.loads(session.get_modelmeta().custom_metadata_map["jbrep"])
    assert said == json.loads(json.dumps(described(controller)))
    chosen, step = None, 0

    def act(observation):  # as a robot would
        nonlocal chosen, step
        if step % said["action_repeat"] == 0:
            (chosen,) = session.run(["action"], {"observation": np.float32(observation)[None]})
        step += 1
        return chosen[0]

    worst, spread = difference_over_an_episode(trained, act)
    assert worst < 1e-6
    assert spread > 1e-3


def test_what_a_file_says_of_its_policy():
    said = described(controller_of(randomised("td3", "full")))
    position = {"name": "position_x", "unit": "m", "low": -2.0, "high": 2.0, "offset": 0.0}
    assert said["observation"][0] == position
    assert (said["action_repeat"], said["control_period"]) == (3, 0.01)
    assert said["rate"] == pytest.approx(100 / 3)
    assert said["action"] == {"low": [-1.0], "high": [1.0]}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    task = describe("Pendulum-v1", episode_steps=30)
    quick = {"steps": 64, "evaluation_episodes": 1, "final_episodes": 1}
    train(Run.of(task, "a2c", overrides={"normalize": True}, **quick), folder / "a")
    done = jbrep("policy", "export", folder / "a", "--out", folder / "a.onnx")
    assert "3 numbers of Pendulum-v1 to 1, 20 times a second" in done.output
    return folder / "a"


def test_the_returns_of_a_file_are_those_of_its_run(run):
    model = run.with_suffix(".onnx")
    playing = ("evaluate-policy", model, "--episodes", 3)
    done = jbrep(*playing, "--beside", run)
    assert float(done.output.split()[-1]) < 1e-2
    assert done.output.startswith(jbrep(*playing).output)  # in the run's environment


def test_the_policy_that_ships_is_exported_by_its_name(tmp_path):
    model, task = tmp_path / "trained.onnx", ("--task", "face_direction")
    exporting = ("policy", "export", "trained", "--out", model)
    assert "policy trained needs a --task" in mistake(*exporting)
    told = jbrep(*exporting, *task).output.splitlines()[-1]
    _, _, checking = told.partition("check it with jbrep ")
    told = " ".join(jbrep(*checking.split(), "--episodes", 1).output.split())
    assert told.startswith(f"face_direction, {model}: median return 9")
    assert "trained: 9" in told


def test_an_encoder_that_is_code_cannot_be_exported(tmp_path):
    trained = randomised("sac", lambda rows: rows[:, :2] * rows[:, 2:4])
    with pytest.raises(InputError, match="the encoder function is code, which a model can't hold"):
        export(controller_of(trained), tmp_path / "it.onnx")


def test_the_example_loop_does_as_the_controller(tmp_path, monkeypatch):
    """Also where steps are late, and where sensors can't be believed."""
    task = describe("Pendulum-v1", hide=["obs_0"], history=3)
    trained = randomised("sac", "full", task)
    controller = controller_of(trained)
    model, controller.hold = tmp_path / "it.onnx", 3
    export(controller, model)
    loop = runpy.run_path(str(EXAMPLE), {}, "loop")
    policy = loop["Policy"](str(model))
    rows = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    for step, row in zip((0, 1, 3, 4, 5), rows, strict=False):
        np.testing.assert_allclose(policy(row, step), controller(row, step), atol=1e-6)
    for lacking in ([np.nan, 0.0], None, [900.0, 0.0]):
        step += 1
        ours = policy(lacking, step)
        np.testing.assert_allclose(ours, controller(None, step), atol=1e-6)
    assert policy(None, step + 1) is None
    with pytest.raises(ValueError, match="they must be obs_1, obs_2"):
        policy([0.0], step + 2)
    monkeypatch.setattr("sys.argv", ["loop.py", str(model), "4"])
    runpy.run_path(str(EXAMPLE), {}, "__main__")


def test_the_example_is_written_beside_the_model(run):
    model = run.with_name("b.onnx")
    assert "b_loop.py" in jbrep("policy", "export", run, "--out", model, "--with-example").output
    loop = model.with_name("b_loop.py")
    assert loop.read_bytes() == EXAMPLE.read_bytes()
    for there, other in ((loop, model), (model, loop)):  # neither is written where one is there
        other.unlink(missing_ok=True)
        there.touch()
        again = jbrep("policy", "export", run, "--out", model, "--with-example")
        assert (again.exit_code, other.exists()) == (2, False)
        there.unlink()
