"""Regressions: what once failed is refused in a line, or works."""

import json
import pickle
import subprocess
import sys
import time
import warnings
from types import SimpleNamespace

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from command import jbrep, mistake, refused
from gymnasium.spaces import Box
from small import brief as settings
from small import write_again
from stable_baselines3 import A2C

from jbrep import JitterbugVecEnv, api
from jbrep.checking.check import _by_turning
from jbrep.collecting import collect
from jbrep.collecting.backends import _can_be_sent
from jbrep.collecting.policies import Heuristic, UserPolicy
from jbrep.coordinates import make_coordinates
from jbrep.dataset import (
    DamageError,
    Dataset,
    Layout,
    ScaledDataset,
    from_arrays,
    from_file,
    from_table,
)
from jbrep.dataset.formats import export
from jbrep.dataset.manifest import find_problems, open_shard
from jbrep.encoders import Encoder, find, save
from jbrep.envs import Feature, Task, describe
from jbrep.envs.autoreset import AutoresetEnvironments
from jbrep.envs.description import with_features
from jbrep.envs.environments import Environments, Retries
from jbrep.envs.names import name_given
from jbrep.errors import STEP_TIMEOUT, InputError, Notice
from jbrep.evaluation.diagnosis import seen
from jbrep.evaluation.evaluation import Score, measured
from jbrep.inspection.scene import as_qpos
from jbrep.jitterbug.gym import JitterbugEnv
from jbrep.methods.fit import Fitter
from jbrep.play.references import policies_of
from jbrep.progress import _Log
from jbrep.records.record import from_plain
from jbrep.rl.normalization import Statistics
from jbrep.rl.overrides import overridden
from jbrep.stats.intervals import Bounds, surely_above
from jbrep.studies.config import Study, as_study
from jbrep.studies.plan import Plan
from jbrep.text import words
from jbrep.training.objective import feature_weights

STUDY = {"tasks": ["Pendulum-v1"], "algorithms": ["sac"], "representations": ["full"], "seeds": [0]}
OPTIONS = ("--task", "Pendulum-v1", "--episode-steps", 20)


class Slow(gymnasium.Env):
    """Its steps take 30 ms, and return their action; above 0.6 a reading is lost."""

    observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        time.sleep(0.03)
        reading = np.float32(np.nan if action[0] > 0.6 else 0)
        return np.full(2, reading), float(action[0]), False, False, {}


gymnasium.register("Regressions/Slow-v0", Slow, max_episode_steps=5)


@pytest.mark.parametrize("kind", ["features", "preset"])
def test_a_stranger_s_study_reads_no_other_file(kind, tmp_path):
    """A study's own file may name others: what is stored holds what they say."""
    secret = tmp_path / "secret.toml"
    secret.write_text("token = 's'")
    told = {"task": "Pendulum-v1", "features": str(secret)}
    said = {
        "features": {"described": {"Pendulum-v1": told}},
        "preset": {"algorithms": ["a"], "learners": {"a": {"base": "sac", "preset": str(secret)}}},
    }
    assert "token" not in refused(from_plain, {**STUDY, **said[kind]}, Study)
    own = as_study({**STUDY, "tasks": [told]})
    assert own.described["Pendulum-v1"].features == {"token": "s"}


def test_the_time_of_a_step_is_that_of_each_robot(monkeypatch):
    monkeypatch.setenv(STEP_TIMEOUT, "0.1")
    envs = Environments(describe("Regressions/Slow-v0"), 6)
    envs.reset([*range(6)], [*range(6)])
    assert not envs.step(np.zeros((6, 1), np.float32)).truncated.any()


def test_what_was_refused_before_its_first_shard_can_be_corrected(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    collect = ("collect", "--policy", "correctable:act", "--out", "data", *OPTIONS, "--steps", 20)
    policy = tmp_path / "correctable.py"
    monkeypatch.syspath_prepend(tmp_path)
    policy.write_text("def act(observation):\n    return 'up'\n")
    assert mistake(*collect)
    policy.write_text("def act(observation):\n    return [0.0]\n")
    monkeypatch.delitem(sys.modules, "correctable")
    assert jbrep(*collect).exit_code == 0
    assert len(Dataset("data")) == 20


def changed(name, value):
    return lambda columns: {**columns, name: np.full_like(columns[name], value)}


def test_ranges_and_lengths_are_verified(brief, tmp_path):
    write_again(brief, tmp_path / "far", changed("action", 5))
    problems = [*find_problems(tmp_path / "far")]
    assert len(problems) == 5
    assert all("action 0 ranges from 5 to 5" in line for line in problems)
    manifest = write_again(brief, tmp_path / "odd")
    entry = manifest.shards[0]
    far = dict.fromkeys(entry.offsets, 10**9)
    for change in ({"offsets": {}}, {"offsets": far}, {"rows": entry.rows - 1}):
        odd = manifest.replace(shards=(entry.replace(**change), *manifest.shards[1:]))
        with pytest.raises(DamageError, match="shard-00000"):
            open_shard(tmp_path / "odd", odd, 0)
    for policy in ({}, {"kind": "trained"}, {"kind": "mixture", "parts": [1]}):
        with pytest.raises(InputError, match="policy"):
            settings(policy=policy)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("observations", 1.0),
        ("final_observations", ["a", "b"]),
        ("episodes/terminated", ["a", "b"]),
        ("episodes/terminated", [np.nan, 0]),
        ("seeds", np.ones((2, 2), int)),
    ],
)
def test_an_npz_with_something_else(name, value, tmp_path):
    numbers = {
        "observations": np.zeros((4, 3)),
        "actions": np.zeros((4, 1)),
        "episode": [0, 0, 1, 1],
        "final_observations": np.zeros((2, 3)),
        "version": 3,  # which no column can be
        "seeds": np.ones((2, 1), int),
        "long": np.zeros(4, np.longdouble),
    }
    path = tmp_path / "some.npz"
    told = ("data", "import", path, "--task", "Pendulum-v1", "--out")
    np.savez(path, **numbers)
    assert jbrep(*told, tmp_path / "out").exit_code == 0
    np.savez(path, **{**numbers, name: value})
    assert "Error: " in mistake(*told, tmp_path / "other")


def test_a_warm_up_is_of_whatever_learns_off_policy():
    within = overridden("sac", "paper", {"warm_up": 0.1}).within(500)
    assert within.algorithm_kwargs["learning_starts"] == 50
    assert "warm_up" in refused(overridden, "ppo", "modern", {"warm_up": 0.1})
    drop = {"top_quantiles_to_drop_per_net": 25}
    assert "quantiles" in refused(overridden, "tqc", "modern", drop)
    assert overridden("tqc", "modern", {**drop, "n_quantiles": 26})


def test_statistics_are_of_what_a_policy_sees():
    good = Statistics(np.zeros(2), np.ones(2), 1e-4).tensors
    assert Statistics.read(good, 2).mean.shape == (2,)
    mean = "statistics.mean"
    for bad in ({}, {**good, mean: np.zeros(1)}, {**good, mean: np.array([0, np.nan])}):
        refused(Statistics.read, bad, 2)


def test_json_stays_json_beside_another_policy():
    command = ("evaluate-policy", "still", *OPTIONS, "--episodes", 1, "--beside", "uniform")
    assert json.loads(jbrep(*command, "--json").stdout)["episodes"] == 1


def test_a_scripted_policy_sees_the_whole_state():
    seen = describe("face_direction", hide=("velocity",), history=2).replace(name="face_direction")
    assert "scripted" not in policies_of(seen)
    assert "scripted" in refused(Heuristic().begin, seen, [0])


def test_a_claim_may_be_tested_at_levels_that_others_pass_on():
    claims = [f"full-standard {claim} than full" for claim in ("better", "less variable")]
    seven = {"tasks": [f"Robot-v{i}" for i in range(7)], "seeds": 8, "verdicts": {"claims": claims}}
    assert as_study({**STUDY, **seven, "representations": ["full", "full-standard"]}).units


def test_a_lost_step_has_the_reward_before_it():
    envs = AutoresetEnvironments(describe("Regressions/Slow-v0", missing="skip"), 1)
    envs.reset([0])
    steps = [envs.step(np.full((1, 1), each)) for each in (0.5, -0.5, 0.7)]
    assert [each.reward.item() for each in steps] == [0.5, -0.5, -0.5]
    assert [each.ended.item() for each in steps] == [False, False, True]


def test_rewards_of_ones_own_stay_known(brief, tmp_path, monkeypatch):
    (tmp_path / "paid.py").write_text("def reward(seen, actions):\n    return actions[:, 0]\n")
    monkeypatch.syspath_prepend(tmp_path)
    jbrep("data", "derive", brief, "--reward", "paid:reward", "--out", tmp_path / "own")
    for to, name in (("parquet", "own.parquet"), ("minari", "sets")):
        jbrep("data", "export", tmp_path / "own", "--to", to, "--out", tmp_path / name)
    (stored,) = (tmp_path / "sets").rglob("data")
    for out, given in (tmp_path / "a", tmp_path / "own.parquet"), (tmp_path / "b", stored):
        jbrep("data", "import", given, "--out", out)
        assert Dataset(out).manifest.settings.reward.startswith("paid:reward ")


def test_a_history_too_long_is_named():
    assert "history" in refused(lambda: describe("face_direction", history=1000))


TASK = describe("face_direction")
made = []


class Robot(gymnasium.Env):
    """Counts how often it is made, and can be switched off."""

    observation_space, action_space, off = Box(-9, 9, (2,)), Box(-1, 1, (1,)), False

    def __init__(self):
        made.append(self)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.float32([1, 2]), {}

    def step(self, action):
        if Robot.off:
            raise RuntimeError("the robot is off")
        return np.float32([1, 2]) + action, 0.5, False, False, {}


gymnasium.register("Regressions/Robot-v0", Robot, max_episode_steps=5)


def named(*names):
    rows = [{"name": name, "unit": name} for name in names]
    return describe("Regressions/Robot-v0", features={"features": rows})


def test_a_clone_is_played_by_one_robot_and_kept_where_that_fails(tmp_path, monkeypatch):
    data = api.collect(named("a", "b"), tmp_path / "data", steps=50, threads=1)
    quick, before = {"steps": 20, "episodes": 6, "threads": 1}, len(made)
    api.clone(data, tmp_path / "one", **quick)
    assert len(made) - before <= 1
    monkeypatch.setattr(Robot, "off", True)
    with pytest.warns(Notice, match="the robot is off"):
        lost = api.clone(data, tmp_path / "off", **quick)
    assert lost.policy([1.0, 2.0]).shape == (1,)
    (tmp_path / "rl").mkdir()
    (tmp_path / "rl/checkpoint.safetensors").touch()  # of a run that goes on
    assert "rl" in refused(api.clone, data, tmp_path / "rl", **quick)


def test_options_that_would_do_nothing_are_refused(tmp_path):
    file = tmp_path / "it.onnx"
    jbrep("policy", "export", "trained", "--task", "face_direction", "--out", file)
    assert "encoder" in mistake("evaluate-policy", file, "--encoder", "dae-4")
    assert "--beside" in mistake("evaluate-policy", file, "--perturb", "--beside", "uniform")
    for algorithm, name in (("sac", "log_std_init"), ("tqc", "use_expln"), ("ppo", "full_std")):
        assert name in refused(overridden, algorithm, "modern", {name: 1})


def test_an_encoder_from_torch_takes_what_has_gradients():
    encoder = Encoder.from_torch(torch.nn.Linear(16, 3), "face_direction")
    assert encoder(torch.zeros(2, 16, requires_grad=True)).shape == (2, 3)


def test_the_jitterbug_is_drawn_whatever_its_features_are_called():
    rows = [{"name": f"f{i}", "group": "g", "kind": "scalar"} for i in range(TASK.size)]
    other = describe("face_direction", features={"features": rows})
    observation = np.random.default_rng(0).normal(size=(3, TASK.size))
    np.testing.assert_array_equal(as_qpos(other, observation), as_qpos(TASK, observation))


def test_what_learned_nothing_saw_no_row(collected):
    assert (
        seen(find("coordinates", describe("InvertedPendulum-v5")), ScaledDataset.of(collected))
        == "none"
    )


def test_statistics_of_large_numbers_keep_their_digits():
    """Also in single precision, as policies elsewhere compute."""
    known = Statistics(np.array([5e6 + 0.3]), np.ones(1), 1.0)
    rows = np.float32([[5e6], [5e6 + 1]])
    mean, rest, deviation = known.arrays
    np.testing.assert_allclose((rows - mean - rest) / deviation, known(rows), atol=1e-6)


def test_angles_of_a_task_are_interpolated_the_shorter_way(tmp_path):
    times = np.arange(60) / 50
    table = dict.fromkeys(TASK.feature_names, np.sin(times)) | {"t": times, "action": np.sin(times)}
    table["motor_angle"] = np.angle(np.exp(1j * (2.6 + 5 * times)))
    layout = Layout(observations=TASK.feature_names, time="t", rate=100, fill="linear")
    data = from_table(tmp_path / "data", table, layout, task=TASK)
    expected = 2.6 + np.arange(len(data)) / 20
    np.testing.assert_allclose(np.exp(1j * data["motor_angle"][:]), np.exp(1j * expected), 1e-5)


def test_a_final_observation_is_a_reading_of_the_clock(tmp_path):
    times, file = np.arange(100) / 100, tmp_path / "some.npz"
    seen = np.stack((times, times), axis=1)
    arrays = {"actions": times[:, None], "t": times, "terminations": times == 0.99}
    finals = {"final_observations": np.ones((1, 2))}
    for name, known in (("once", finals), ("each", {"next_observations": seen + 0.01})):
        np.savez(file, observations=seen, **arrays, **known)
        data = from_file(tmp_path / name, file, layout=Layout(time="t", rate=1000, fill="linear"))
        assert (len(data), data.episodes["terminated"].tolist()) == (1000, [True])
    seen[50:, 1] = np.nan  # silent, so that the last observation belongs to no step
    np.savez(file, observations=seen, **arrays, **finals)
    data = from_file(tmp_path / "silent", file, layout=Layout(time="t", rate=100, gap=0.1))
    assert data.episodes["final_observation"][0] == pytest.approx([0.59, 0.49])
    assert not data.episodes["terminated"][0]


def test_columns_of_another_order_and_odd_episodes_are_refused(tmp_path):
    data = api.collect(named("a", "b"), tmp_path / "data", steps=10)
    file = tmp_path / "it.parquet"
    jbrep("data", "export", data.folder, "--to", "parquet", "--out", file)
    assert "'a' where" in refused(from_file, tmp_path / "no", file, task=named("b", "a"))
    beside = tmp_path / "it-episodes.parquet"
    table = pq.read_table(beside)
    for name in ("seed", "final_observation"):
        place, words = table.schema.get_field_index(name), [["x"] * len(table)]
        pq.write_table(table.set_column(place, name, words), beside)
        assert "can't be read" in refused(from_file, tmp_path / "no", file)


def test_numbers_that_begin_with_a_point_and_offsets_that_stay():
    domain = describe("face_direction", domain={"noise": ".1", "mass": ".5..1.5"}).domain
    assert (domain.noise, domain.mass) == ((0.1, 0.1), (0.5, 1.5))
    assert describe("Regressions/Robot-v0", action_bounds="-.5...5").action_low == (-0.5,)
    rows = [{"name": "a", "offset": 5.0, "low": -1.0}, {"name": "b"}]
    task = describe("Regressions/Robot-v0", features={"features": rows})
    again = with_features(task, {"features": [{"name": "c"}, {"offset": 1.0}]})
    assert again.offsets == {"c": 5.0, "b": 1.0}


def test_a_reward_before_any_is_missing(tmp_path):
    table = {"t": np.arange(6.0), "x": np.arange(6.0), "u": np.arange(6.0)}
    table["reward"] = [np.nan, *[5.0] * 5]
    layout = Layout(observations=("x",), actions=("u",), time="t")
    assert "the reward is" in refused(from_table, tmp_path / "no", table, layout, missing="hold:1")


def test_a_class_of_a_script_has_the_same_digest_in_each_process():
    script = "class A: pass\nfrom jbrep.envs.names import digest_of\nprint(digest_of(A))"
    runs = [subprocess.run([sys.executable, "-c", script], capture_output=True) for _ in "ab"]
    assert runs[0].stdout == runs[1].stdout != b""


class Rail(gymnasium.Env):
    """A cart on a rail; `how` it differs from a plain one."""

    observation_space, action_space = Box(-9, 9, (2,)), Box(-1, 1, (1,))
    breaks = False  # in the first step of an episode that begins on the right

    def __init__(self, how="", scale=1.0):
        self.how, self.scale, self.steps = how, scale, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.how == "global":
            np.random.seed(seed)  # noqa: NPY002
        self.state, self.steps = self.np_random.uniform(-1, 1, 2).astype(np.float32), 0
        return self.state.copy(), {}

    def step(self, action):
        self.steps += 1
        if self.breaks and self.steps == 1 and self.state[0] > 0:
            raise OSError("unplugged")
        noise = np.random.randn() if self.how == "global" else 0  # noqa: NPY002
        self.state = np.clip(self.state + 0.1 * (action[0] + noise), -9, 9, dtype=np.float32)
        return self.state.copy(), self.scale * float(self.state[0]), False, False, {}


gymnasium.register("Regressions/Rail-v0", Rail, max_episode_steps=4, reward_threshold=9)


def test_an_instance_is_one_robot_and_local_classes_are_several():
    one = describe(Rail(), episode_steps=4)
    alone = api.evaluate_policy("still", task=one, episodes=3, threads=1)
    assert [*api.evaluate_policy("still", task=one, episodes=3)] == [*alone]
    with Environments(one, 1), pytest.raises(InputError, match="exists once"):
        Environments(one, 1)

    def robot(scale):
        class Local(Rail):
            def __init__(self):
                super().__init__(scale=scale)

        return Local

    few, many = (describe(robot(scale), episode_steps=4) for scale in (1.0, 100.0))
    returns = [np.sum(api.evaluate_policy("still", task=each, episodes=2)) for each in (few, many)]
    assert returns[1] == pytest.approx(100 * returns[0])


def test_what_gymnasium_made_keeps_its_time_limit_and_a_threshold_is_of_its_own():
    task = describe(gymnasium.make("Regressions/Rail-v0", max_episode_steps=3))
    assert (task.max_episode_steps, task.solved_return) == (3, None)
    assert describe("Regressions/Rail-v0").solved_return == 9


def test_who_shares_a_generator_with_others_is_not_reproducible():
    made = {how: describe("Regressions/Rail-v0", env={"how": how}) for how in ("", "global")}
    assert [each.reproducible for each in made.values()] == [True, False]


@pytest.mark.parametrize(
    "odd",
    [
        {"env": {"how": b"x"}},
        *({"action_bounds": bounds} for bounds in (((-1, 1), (3,)), 1.0)),
        {"hide": "none"},
    ],
)
def test_odd_descriptions_are_refused(odd):
    with pytest.raises(InputError, match=r"env|action_bounds|'none'"):
        describe("Regressions/Rail-v0", **odd)


def test_a_first_step_that_fails_has_no_reward_of_the_episode_before(monkeypatch):
    envs = AutoresetEnvironments(describe("Regressions/Rail-v0"), 4, retries=99)
    monkeypatch.setattr(Rail, "breaks", True)
    envs.reset([0, 1, 2, 3])
    with pytest.warns(Notice, match="unplugged"):
        steps = [envs.step(np.ones((4, 1))) for _ in range(20)]
    lost = [step.reward[i] for step in steps for i in range(4) if not step.length[i]]
    assert lost
    assert not np.any(lost)


def test_a_heading_comes_back_whatever_the_order_of_features():
    kinds = {"v_x": "vector", "v_y": "vector", "goal_x": "offset", "goal_y": "offset"}
    told = [Feature(n, kind=k, frame="world", group=k) for n, k in kinds.items()]
    told.append(Feature("heading", "rad", kind="angle", frame="world"))
    rows = np.array([[0.3, 0.4, 1.0, 2.0, 0.0]])
    for order in (range(5), (4, 0, 1, 2, 3)):
        features = tuple(told[i] for i in order)
        ends = {"action_low": (-1,), "action_high": (1,), "max_episode_steps": 9}
        task = Task(id="Planar-v0", name="Planar-v0", features=features, **ends)
        made = make_coordinates(task, "symmetry")
        back = made.inverse(made.forward(rows[:, order]))
        np.testing.assert_allclose(back, rows[:, order], atol=1e-5)


def test_one_lucky_run_is_not_above_the_least_return():
    assert not surely_above(np.array([*[0.0] * 7, 1.0]), 0.0, Bounds(0.0))
    assert surely_above(np.array([*[1.0] * 7, 2.0]), 0.0, Bounds(0.0))


def test_encoders_of_other_features_or_weights_are_others(tmp_path):
    table = dict(zip("xyu", np.random.default_rng(0).normal(size=(3, 60)), strict=True))
    layout = {"observations": ("x", "y"), "actions": ("u",), "length": 20}
    plain, angle = (
        ScaledDataset(from_table(tmp_path / name, table, Layout(**layout, angles=angles)))
        for name, angles in (("plain", ()), ("angle", ("x",)))
    )
    encoder = Fitter(plain, tmp_path / "out").fit("pca", latent=1).encoder
    assert "features" in refused(Fitter(angle, tmp_path / "out").fit, "pca", latent=1)
    assert "4,096" in refused(Fitter(plain, tmp_path).plan, "ofe", latent=2500)
    assert "name" in refused(Fitter(plain, tmp_path).plan, "pca", latent=1, name="full")
    for weights in ({"x": 5, "*": 1}, {"*": 1, "x": 5}):
        assert feature_weights(plain, weights).tolist() == [5, 1]
    out = tmp_path / "text"
    assert "is 12:" in refused(api.train_encoders, tmp_path / "plain", out, "pca", latent="12")
    encoder = encoder.with_header(
        training={"epochs": 9}, metrics={"epochs": 2, "held_out_mse": 0.1}
    )
    save(encoder, tmp_path / "stopped.safetensors")
    with pytest.warns(Notice, match="2 epochs of 9"):
        find(tmp_path / "stopped.safetensors", plain.task)


def test_a_score_that_is_not_finite_is_not_known(monkeypatch):
    odd = [(lambda judged: Score(np.nan, 0.0, np.inf), ("odd",))]
    monkeypatch.setattr("jbrep.evaluation.evaluation._REGISTERED", odd)
    assert measured(None) == {"odd": Score(None, 0.0, None)}


def test_rows_count_until_more_of_their_shard_are_written(tmp_path, monkeypatch):
    collect(settings(steps=150, shard_episodes=3), tmp_path)
    data = Dataset(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("jbrep.dataset.manifest.write_whole", lambda *_: refuse())
        assert "2 episodes of 200 rows are kept" in refused(
            collect, settings(steps=300, shard_episodes=3), tmp_path
        )
    assert len(Dataset(tmp_path)) == 200
    collect(settings(steps=300, shard_episodes=3), tmp_path)
    assert "open it again" in refused(lambda: data["reward"][:])


def refuse(*given):
    raise InputError("no space")


def test_a_model_that_saw_scaled_states_is_refused_and_odd_policies_stay_here():
    model = A2C("MlpPolicy", JitterbugVecEnv("face_direction", 1))
    assert "scaled" in refused(UserPolicy.of, model)
    odd = type("Odd", (), {"__reduce__": lambda self: 1 / 0})
    assert not _can_be_sent(odd())
    assert "retries" in refused(Retries, -1)


def gone(*_):
    raise BrokenPipeError


def test_nobody_who_reads_and_no_working_folder(tmp_path, monkeypatch, brief):
    stream = SimpleNamespace(write=gone, flush=gone)
    _Log(stream).write("a line")
    _Log(stream).flush()
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert jbrep("data", "info", brief).exit_code == 0


def test_numbers_of_numpy_are_numbers():
    few = describe(
        "Regressions/Rail-v0", action_bounds=[*zip(-np.ones(1), np.ones(1), strict=True)]
    )
    assert few == describe("Regressions/Rail-v0", action_bounds=np.array([[-1, 1]]))
    ends = {"action_low": tuple(-np.ones(1)), "action_high": np.ones(1), "max_episode_steps": 9}
    assert Task(id="A-v0", name="A-v0", features=(Feature("x"),), **ends).action_high == (1.0,)
    named = describe(gymnasium.make("Regressions/Rail-v0", scale=np.float64(2)))
    assert named.arguments == {"scale": 2.0}


class Left:
    class Robot(Rail):
        pass


class Right:
    class Robot(Rail):
        pass


def test_nested_classes_of_one_name_are_several():
    names = [describe(each.Robot, episode_steps=4).id for each in (Left, Right)]
    assert names[0] != names[1] == name_given(f"{__name__}:Right.Robot")


def test_environments_begin_with_a_reset_and_a_seed():
    with pytest.raises(InputError, match="reset"):
        JitterbugVecEnv("face_direction", 1).step(np.zeros((1, 1)))
    assert "seed" in refused(JitterbugVecEnv, "face_direction", 1, seed=-1)


def test_a_likelihood_that_is_not_finite_ends_in_a_line(brief, tmp_path):
    wild = {"loss": "gaussian", "steps": 200, "overrides": {"learning_rate": 1e6}}
    assert "diverged" in refused(api.clone, brief, tmp_path / "clone", episodes=1, **wild)


def test_a_warning_of_the_robot_s_does_not_hide_its_symmetry(monkeypatch):
    step = JitterbugEnv.step

    def warned(self, action):
        warnings.warn("old", DeprecationWarning, stacklevel=2)
        return step(self, action)

    monkeypatch.setattr(JitterbugEnv, "step", warned)
    assert _by_turning(describe("face_direction"))[1]


def test_a_log_s_roles_names_and_order_are_what_they_say(tmp_path):
    table = {"t": np.arange(4.0), "pos": np.ones(4), "cmd": np.ones(4)}
    both = Layout(observations=("*s", "cmd"), actions=("cmd",), time="t")
    assert "cmd in the observation" in refused(from_table, tmp_path / "no", table, both)
    assert words(["a_x", "a x", "a_x_2"]) == ["a_x", "a_x_3", "a_x_2"]
    task = describe("Regressions/Rail-v0")
    others = [{"name": name} for name in reversed(task.feature_names)]
    assert "another place" in refused(with_features, task, {"features": others})
    names = [{"name": f"q_{each}", "kind": "quaternion", "group": "q"} for each in "xyzw"]
    four = Task(
        **{"id": "Q-v0", "name": "Q-v0", "features": tuple(map(Feature, "abcd"))},
        **{"action_low": (-1,), "action_high": (1,), "max_episode_steps": 9},
    )
    assert "w, x, y, z" in refused(with_features, four, {"features": names})


def test_episodes_of_another_export_are_refused_and_masks_are_gaps(tmp_path):
    for name, rows in (("a", 4), ("b", 5)):
        ends = np.arange(rows) == rows - 1
        given = np.ones((rows, 2)), np.ones((rows, 1)), ends * 1.0, ends
        data = from_arrays(tmp_path / name, *given)
        export(data, "parquet", tmp_path / f"{name}.parquet")
    (tmp_path / "b-episodes.parquet").replace(tmp_path / "a-episodes.parquet")
    assert "of one export" in refused(from_file, tmp_path / "c", tmp_path / "a.parquet")
    masked = np.ma.masked_greater(np.arange(8.0).reshape(4, 2), 3)
    told = refused(from_arrays, tmp_path / "d", masked, np.ones((4, 1)), np.ones(4), np.ones(4))
    assert "row 2: 'observation.obs_0'" in told


def test_the_processes_of_a_study_register_what_this_one_did(monkeypatch):
    plan = Plan(as_study(STUDY | {"tasks": ["Regressions/Rail-v0"]}), "none")
    sent = pickle.loads(pickle.dumps(plan.known))
    monkeypatch.delitem(gymnasium.registry, "Regressions/Rail-v0")
    sent.take()
    assert gymnasium.spec("Regressions/Rail-v0").entry_point is Rail


def test_settings_that_no_run_can_have(tmp_path):
    set_to = {"action_repeat": 5, "buffer_size": 1e5}
    assert "an episode" in refused(api.train, "Regressions/Rail-v0", tmp_path, overrides=set_to)
    assert "normalize" in refused(api.train, "face_direction", tmp_path, normalize="no")
