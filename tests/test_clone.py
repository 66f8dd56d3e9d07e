"""Policies that are learned from data alone: cloned, or better than what acted."""

import json

import numpy as np
import onnxruntime
import pytest
import torch
from command import jbrep as command
from command import mistake
from small import assert_same_files

import jbrep
from jbrep.cloning import clone as cloning
from jbrep.cloning.objective import PolicyInputs
from jbrep.collecting.derive import derive
from jbrep.dataset import Dataset, Layout, from_table
from jbrep.encoders import find
from jbrep.envs.names import import_modules
from jbrep.errors import InputError
from jbrep.play.sources import find_player
from jbrep.rl.controller import export
from jbrep.training.windows import Windows

pytestmark = pytest.mark.filterwarnings("ignore:.* names no environment:jbrep.errors.Notice")
QUICK = {"steps": 400, "overrides": {"net_arch": [32], "learning_rate": 1e-2, "batch_size": 128}}
FILES = ("policy.safetensors", "encoder.safetensors", "clone.json", "evaluations.csv")


def teacher(states):
    """Its two commands, within [-1, 1]."""
    angle, rate = np.atleast_2d(states).T
    return np.stack((np.sin(angle) - 0.3 * rate, 0.5 * np.tanh(rate)), 1).clip(-1, 1)


def log_of(folder, acts, **columns):
    """The log of a robot that nobody has an environment of, 20 episodes of 40 rows."""
    random = np.random.default_rng(0)
    states = random.uniform(-2, 2, (800, 2))
    first, second = acts(states, random).T
    table = {"angle": states[:, 0], "rate": states[:, 1], "u": first, "v": second}
    table |= {"trial": np.arange(800) // 40}
    table |= {name: make(states, first, second) for name, make in columns.items()}
    layout = Layout(observations=("angle", "rate"), actions=("u", "v"), episode="trial")
    return from_table(folder, table, layout)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def log(home):
    return log_of(home / "walk", lambda states, random: teacher(states))


@pytest.fixture(scope="module")
def cloned(home, log):
    with pytest.warns(jbrep.errors.Notice, match="names no environment"):
        return jbrep.clone(log, home / "bc", **QUICK)


def test_a_clone_does_what_its_teacher_did(log, cloned):
    told = cloned.clone
    losses = [epoch.test_loss for epoch in told.epochs]
    assert told.best_epoch == losses.index(min(losses)) + 1
    assert min(losses) < 0.1 * losses[0]
    assert told.error.mse == pytest.approx(min(losses), rel=1e-4)
    assert told.error.mse == pytest.approx(np.mean([each.mse for each in told.actions]), rel=1e-4)
    assert [each.name for each in told.actions] == ["u", "v"]
    assert told.times[0].name == "steps 0-2"
    assert min(each.r2 for each in (*told.actions, *told.times)) > 0.9
    states = log["observation"][:50]
    np.testing.assert_allclose(cloned.policy(states), teacher(states), atol=0.3)
    assert (told.data, told.policy, len(cloned.returns)) == (None, None, 0)
    assert "not played" in repr(cloned)


def test_one_that_learns_no_more_is_stopped_and_its_best_epoch_is_kept(home, log):
    settings = {**QUICK, "steps": 4000, "patience": 2}
    told = jbrep.clone(log, home / "early", **settings).clone
    assert len(told.epochs) == told.best_epoch + 2 < 4000 // 5


def test_it_sees_any_encoder_scaled_alike(home, log):
    encoder = jbrep.train_encoder(log, home / "encoders", "pca", latent=1)
    seen = PolicyInputs(log, encoder)
    rows = seen.load(seen.train)
    assert rows.shape == (len(seen.train), 1)
    np.testing.assert_allclose([rows.mean(), rows.std()], [0, 1], atol=1e-5)
    agent = jbrep.clone(log, home / "coded", encoder=encoder, **QUICK | {"steps": 20})
    assert agent.policy.encoder.name == "pca-1"


@pytest.mark.parametrize(
    "settings", [{}, {"chunk": 3}, {"loss": "gaussian", "chunk": 2}], ids=["one", "chunk", "gauss"]
)
def test_its_file_plays_like_the_clone_and_so_does_its_model(settings, home, log):
    name = "-".join(map(str, settings.values())) or "plain"
    agent = jbrep.clone(log, home / name, **QUICK, **settings)
    assert agent.clone.error.r2 > (0.8 if not settings else -0.5)
    from_file = jbrep.load_policy(home / name / "policy.safetensors")
    export(agent.policy, home / f"{name}.onnx")
    session = onnxruntime.InferenceSession(home / f"{name}.onnx")
    said = json.loads(session.get_modelmeta().custom_metadata_map["jbrep"])
    chunk = settings.get("chunk", 1)
    assert said["chunk"] == chunk
    states = log["observation"][:4]
    (at_once,) = session.run(["action"], {"observation": states})
    assert at_once.shape == (4, 2 * chunk)
    for i in range(2 * chunk):  # it looks again after a chunk
        now = states if i % chunk == 0 else np.zeros_like(states)
        acted = from_file(now)
        np.testing.assert_allclose(acted, at_once[:, 2 * (i % chunk) :][:, :2], atol=1e-6)
    assert np.abs(at_once).max() <= 1


def test_one_that_was_killed_ends_with_the_same_bytes(home, log, cloned, monkeypatch):
    monkeypatch.setattr(cloning, "_SAVE_EVERY", 0)
    save, done = cloning.Trainer.save, []

    def save_then_die(trainer, *where):
        save(trainer, *where)
        done.append(len(trainer.history))
        if len(done) == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(cloning.Trainer, "save", save_then_die)
    with pytest.raises(KeyboardInterrupt):
        jbrep.clone(log, home / "killed", **QUICK)
    with pytest.raises(InputError, match="belongs to another configuration: seed"):
        jbrep.clone(log, home / "killed", seed=1, **QUICK)
    assert not (home / "killed/run.json").exists()
    jbrep.clone(log, home / "killed", **QUICK)
    assert done[4] == 5
    assert_same_files(home / "bc", home / "killed", *FILES)
    assert not (home / "killed/training.safetensors").exists()
    jbrep.clone(log, home / "killed", **QUICK)  # nothing to do
    with pytest.raises(InputError, match=r"cloned\.chunk 1"):
        jbrep.clone(log, home / "killed", chunk=2, **QUICK)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"method": "td3+bc", "chunk": 2}, "chunk is 2"),
        ({"method": "td3+bc", "loss": "gaussian"}, "loss is gaussian"),
        ({"method": "cql"}, "method is"),
        ({"overrides": {"gamma": 0.9}}, "gamma"),
        ({"overrides": {"learning_rate": "linear:1e-3"}}, "learning_rate"),
        ({"encoder": "dea-8"}, "dea-8"),
        ({"chunk": 41}, "more than 40 steps"),
        ({"method": "td3+bc"}, "derive --reward"),
    ],
)
def test_what_cannot_be_learned_is_refused(settings, field, log, tmp_path):
    with pytest.raises(InputError, match=field):
        jbrep.clone(log, tmp_path / "no", **settings)
    assert not (tmp_path / "no/run.json").exists()


def test_offline_rl_does_better_than_what_acted(home, log):
    """Actions are random; the reward is the better, the nearer they are to the teacher's."""

    def at_random(states, random):
        return random.uniform(-1, 1, states.shape)

    def reward(states, first, second):
        return 1 - np.square(np.stack((first, second), 1) - teacher(states)).sum(1)

    data = log_of(home / "random", at_random, reward=reward)
    overrides, states, error = QUICK["overrides"], data["observation"][:200], {}
    for method, more in (("bc", {}), ("td3+bc", {"gamma": 0.0})):
        settings = {"method": method, "steps": 500, "overrides": overrides | more}
        agent = jbrep.clone(data, home / f"random-{method}", **settings)
        error[method] = np.square(agent.policy(states) - teacher(states)).mean()
        assert agent.clone.data.episodes == 20
    assert error["td3+bc"] < 0.5 * error["bc"]
    assert len(agent.clone.epochs) == agent.clone.best_epoch


@pytest.fixture(scope="module")
def upright(home):
    task = jbrep.describe("InvertedPendulum-v5", episode_steps=4)
    return jbrep.collect(task, home / "upright", 400, seed=1)


def test_what_follows_an_episode_is_what_was_seen_at_its_end(upright):
    seen = PolicyInputs(upright, find("full", upright.task))
    windows = Windows(seen, seen.train)
    rows, ended = windows.after(windows.numbers)
    episodes = upright.episodes
    assert len(set(episodes["terminated"])) == 2
    numbers = upright["episode"][seen.train]
    last = np.append(numbers[1:] != numbers[:-1], True)
    finals = seen.scale(episodes["final_observation"][numbers[last]])
    np.testing.assert_array_equal(rows[last], finals)
    np.testing.assert_array_equal(ended[last], episodes["terminated"][numbers[last]])
    np.testing.assert_array_equal(rows[~last], seen.load(seen.train[~last] + 1))
    assert not ended[~torch.from_numpy(last)].any()


def test_a_clone_with_an_environment_plays_it_like_a_run(home, upright):
    told = command(
        *("clone", "--data", home / "upright", "--steps", 100, "--episodes", 12, "--chunk", 2),
        *("--set", "net_arch=[8]", "--out", home / "plays"),
    ).output
    agent = jbrep.clone(
        upright, home / "plays", steps=100, episodes=12, chunk=2, overrides={"net_arch": [8]}
    )
    assert f"policy {agent.clone.policy}" in told
    assert agent.returns.shape == (12,)
    assert agent.clone.data.mean == pytest.approx(upright.episodes["return"].mean())
    again = find_player(str(home / "plays")).returns(12)
    np.testing.assert_allclose(agent.returns, again, atol=1e-3)
    export(agent.policy, home / "plays.onnx")
    alone = find_player(home / "plays.onnx").returns(12)
    np.testing.assert_allclose(alone, again, atol=1e-3)
    kept = jbrep.collect(upright.task, home / "by-the-clone", 60, policy=str(home / "plays"))
    assert kept.manifest.settings.policy["run"] == str(home / "plays")


def test_returns_of_other_rewards_are_not_compared(home, upright, monkeypatch):
    (home / "some_rewards.py").write_text("def one(seen, acts):\n    return 0 * seen[:, 0] + 1\n")
    monkeypatch.syspath_prepend(home)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    import_modules(["some_rewards"])
    derive(upright.folder, home / "ones", reward="some_rewards:one")
    with pytest.warns(jbrep.errors.Notice, match="can't be compared"):
        jbrep.clone(Dataset(home / "ones"), home / "other", steps=10, episodes=1)


def test_a_data_set_that_is_given_as_a_task_leads_to_clone(log, home, monkeypatch):
    monkeypatch.chdir(home)
    assert "jbrep clone --data walk" in mistake("rl", "--task", "walk", "--out", "runs/a")
