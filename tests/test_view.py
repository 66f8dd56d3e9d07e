"""What is seen of a robot: some of its features, and those of the steps before."""

from importlib import import_module

import numpy as np
import pytest
from command import jbrep, mistake
from test_controller import controller_of, difference_over_an_episode, randomised

from jbrep.collecting import collect
from jbrep.collecting.derive import derive
from jbrep.dataset import Dataset, DataSettings, ScaledDataset
from jbrep.envs import Environments, describe
from jbrep.envs.names import import_modules
from jbrep.envs.view import with_view
from jbrep.evaluation import regression
from jbrep.evaluation.diagnosis import diagnose
from jbrep.methods.fit import Fitter
from jbrep.rl.controller import export

import_modules(["environments"])
TASK = "move_in_direction"


@pytest.fixture(scope="module")
def task():
    return describe(TASK, {}, 20)


@pytest.fixture(scope="module")
def seen(task):
    return with_view(task, ["*velocity*"], history=3)


def test_features_have_names_in_the_past(task, seen):
    now = [name for name in task.feature_names if "velocity" not in name]
    assert seen.feature_names[: len(now)] == tuple(now)
    assert seen.feature_names[len(now)] == "position_x.1"
    assert seen.feature_names[-2:] == ("action.1", "action.2")
    assert seen.size == 3 * len(now) + 2
    assert seen.whole == task.replace(name=seen.name)


def stacked(envs, act):
    """What would be seen of the whole observations, stacked by hand, and the rewards."""
    names = [i for i, name in enumerate(envs.task.feature_names) if "velocity" not in name]
    states = [envs.observation[:, names]] * 3
    actions = [np.zeros((envs.num_envs, 1))] * 2
    yield np.hstack([*states, *actions])
    while envs.num_active:
        action = act()
        states = [envs.step(action).observation[:, names], *states[:2]]
        actions = [action, actions[0]]
        yield np.hstack([*states, *actions])


def test_environments_show_the_steps_before(task, seen):
    random = np.random.default_rng(0)
    drives = random.uniform(-1, 1, (20, 4, 1))
    whole, envs = Environments(task, 4), Environments(seen, 4)
    for each in (whole, envs):
        each.reset(range(4), [3, 4, 5, 6])
    expected = stacked(whole, iter(drives).__next__)
    np.testing.assert_array_equal(envs.observation, next(expected))
    for drive, wanted in zip(drives, expected, strict=True):
        np.testing.assert_array_equal(envs.step(drive).observation, wanted)
    assert not envs.num_active


@pytest.mark.parametrize("change", [{"history": 3}, {"domain": {"noise": 0.1}}])
def test_a_step_that_is_lost_is_not_seen(change):
    broken = describe("Sledges/Broken-v0", {"how": "nan", "seed": 5}, 30, missing="skip", **change)
    envs = Environments(broken, 1)
    envs.reset([0], [5])
    while not envs.lost.any():
        before = envs.observation
        envs.step(np.full((1, 3), 0.5))
    np.testing.assert_array_equal(envs.observation, before)
    assert envs.steps.tolist() == [3]


@pytest.mark.parametrize(
    ("name", "arguments", "steps", "missing"),
    [
        (TASK, {}, 20, None),
        ("Sledges/Sledge-v0", {}, None, None),
        ("Sledges/Broken-v0", {"how": "nan", "seed": (1 << 32) + 2}, 30, "skip"),  # in episode 2
    ],
)
def test_a_derived_data_set_is_as_if_it_were_collected(name, arguments, steps, missing, tmp_path):
    task = describe(name, arguments, steps, missing=missing)
    hidden = task.feature_names[1:2]
    settings = DataSettings(task=task, steps=300, shard_episodes=4)
    collect(settings, tmp_path / "whole", num_threads=1)
    derive(tmp_path / "whole", tmp_path / "derived", hidden, 3)
    collect(
        settings.replace(task=with_view(task, hidden, 3)), tmp_path / "collected", num_threads=1
    )
    derived, collected = Dataset(tmp_path / "derived"), Dataset(tmp_path / "collected")
    assert len(derived.episodes["length"]) > 4
    assert missing is None or derived.episodes["length"][2] == 3
    assert derived.task.size == 3 * (task.size - 1) + 2 * task.action_size
    for column in collected.columns:
        assert derived[column][:].tobytes() == collected[column][:].tobytes(), column
    for column, values in collected.episodes.items():
        assert derived.episodes[column].tobytes() == values.tobytes(), column


def test_a_controller_keeps_the_history_itself(seen):
    trained = randomised("td3", "full", seen)
    now = len(seen.view.places)
    controller = controller_of(trained)
    worst, spread = difference_over_an_episode(
        trained, lambda observation: controller(observation[:now]), steps=20
    )
    assert worst < 1e-6 < 1e-3 < spread
    controller.reset()
    several = np.random.default_rng(0).normal(size=(4, now))
    alone = controller_of(trained)
    np.testing.assert_allclose(controller(several)[0], alone(several[0]), atol=1e-6)


@pytest.fixture
def on_robot(seen, tmp_path, monkeypatch):
    """A policy as a function and on a robot, which holds each action for three steps; sensors."""
    monkeypatch.syspath_prepend("examples/robot")
    controller = controller_of(randomised("td3", "full", seen))
    export(controller, tmp_path / "it.onnx")
    robot = import_module("controller").Controller(str(tmp_path / "it.onnx"))
    low, high = np.array([(each.low, each.high) for each in seen.features[: robot.size]]).T
    shown = np.random.default_rng(0).uniform(low, high, (8, robot.size)).astype(np.float32)
    return controller, robot, shown


def test_a_robot_keeps_the_history_of_an_exported_policy(on_robot):
    controller, robot, shown = on_robot
    for step, sensors in enumerate(shown):
        np.testing.assert_allclose(robot.act(step, sensors), controller(sensors), atol=1e-6)


def test_a_robot_goes_on_after_sensors_that_are_not_believed(on_robot):
    controller, robot, shown = on_robot
    unknown = np.full(robot.size, np.nan, np.float32)
    first, _, third = (robot.act(step, shown[step]) for step in range(3))
    assert robot.act(3, unknown) is None  # where another action was due
    late = robot.act(4, shown[4])
    past = np.concatenate([shown[4], shown[2], shown[2], robot.safe, third])
    expected = controller.acting.actions(controller.encoder.encode(past))
    np.testing.assert_allclose(late, expected, atol=1e-6)
    np.testing.assert_array_equal(robot.act(5, shown[5]), late)
    assert robot.act(0, unknown) is None  # another episode, which knows nothing of this one
    np.testing.assert_array_equal(robot.act(1, shown[0]), first)


def test_commands_take_what_is_seen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(command):
        told = jbrep(*command.split())
        assert told.exit_code == 0, told.output
        return told.output

    hide = "--hide *velocity* --history 2"
    task = f"--task {TASK} --episode-steps 20"
    short = "--steps 200 --evaluate-every 100 --evaluation-episodes 1 --final-episodes 1"
    run(f"collect {task} --steps 200 --out whole")
    run(f"data derive whole {hide} --out seen")
    run("data verify seen --replay 2")
    run("train-encoder --kind pca --latent 4 --data seen --out codes --name code")
    run("evaluate --encoder codes/code.safetensors --data seen --out evaluation")
    given = f"--encoder codes/code.safetensors {short}"
    assert "made for other features" in mistake(*f"rl {task} {given} --out other".split())
    run(f"rl {task} {hide} {given} --out run")
    run("policy export run --out it.onnx")
    told = run("evaluate-policy it.onnx --beside run --episodes 2")
    assert float(told.rpartition("differ by at most ")[2]) < 1e-5


SPEED = "obs_2"


@pytest.fixture(scope="module", autouse=True)
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(regression, "_STEPS", 300)
        yield


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """A pendulum, whose speed is hidden in two other data sets."""
    folder = tmp_path_factory.mktemp("swing")
    settings = DataSettings(task=describe("Pendulum-v1"), steps=6000, seed=2)
    collect(settings, folder / "whole", num_threads=1)
    derive(folder / "whole", folder / "now", [SPEED])
    derive(folder / "whole", folder / "history", [SPEED], 2)
    return folder


def estimated(folder, view, latent):
    """R² of the hidden speed, and of the reward of 10 steps, from a code of what is seen."""
    data = ScaledDataset(Dataset(folder / view))
    encoder = Fitter(data, folder / view).fit("linear-forward", latent=latent).encoder
    evaluation = diagnose({"code": encoder}, data, truth=Dataset(folder / "whole"))
    assert evaluation.data.hidden == (SPEED,)
    known = evaluation.encoders["code"]
    return known.nonlinear_probes[SPEED].value, known.prediction["10"].reward.value


def test_a_code_of_a_history_tells_what_one_of_an_observation_does_not(swing):
    speed, reward = estimated(swing, "now", 2)
    of_history = estimated(swing, "history", 3)
    assert speed < 0.1
    assert of_history[0] > 0.9
    assert of_history[1] > reward + 0.3


def test_a_data_set_of_a_trained_policy_keeps_it(tmp_path):
    task = ("--task", "face_direction", "--episode-steps", 20)
    jbrep("collect", *task, "--policy", "trained", "--steps", 40, "--out", tmp_path / "whole")
    hidden = ("--hide", "*velocity*", "--out", tmp_path / "seen")
    assert jbrep("data", "derive", tmp_path / "whole", *hidden).exit_code == 0
    assert "no problems" in jbrep("data", "verify", tmp_path / "seen").output


def test_the_command_tells_it(swing, monkeypatch):
    monkeypatch.chdir(swing)
    train = ("train-encoder", "--kind", "linear-forward", "--latent", "3", "--data", "history")
    jbrep(*train, "--out", "encoders")
    encoder = "encoders/linear-forward-3.safetensors"
    judge = ("evaluate", "--encoder", encoder, "--data", "history", "--out", "judged")
    told = jbrep(*judge, "--truth", "whole").output
    assert "What isn't observed, predicted from the latent: R², nonlinear\n\nfeature  full" in told
    assert f"\n{SPEED}    " in told
    assert "is not an evaluation of these encoders" in mistake(*judge)


def test_the_truth_is_of_the_same_motion_and_shows_more(swing, tmp_path, monkeypatch):
    monkeypatch.chdir(swing)
    judge = ("evaluate", "--encoder", "full", "--data", "now", "--truth")
    assert "now shows nothing that now hides" in mistake(*judge, "now")
    settings = DataSettings(task=describe("Pendulum-v1"), steps=6000, seed=3)
    collect(settings, tmp_path / "other", num_threads=1)
    assert "has other actions than now: the truth must be" in mistake(*judge, tmp_path / "other")
