"""Policies of one's own: named as code or given as objects, wherever a policy is taken."""

import json

import gymnasium
import numpy as np
import pytest
from command import jbrep, mistake
from stable_baselines3 import PPO

import jbrep as package
from jbrep.dataset import Dataset
from jbrep.envs import describe
from jbrep.envs.names import import_modules
from jbrep.errors import InputError
from jbrep.play.sources import find_policy
from jbrep.rl.files import EVALUATION_SEED

import_modules(["test_own_policies"])
PENDULUM = describe("Pendulum-v1", episode_steps=20)
HERE = "test_own_policies"
OPTIONS = ("--task", "Pendulum-v1", "--episode-steps", 20)


def swing(observation):
    """Along the velocity, more than the bounds allow where it is fast."""
    return [3 * observation[2]]


def swing_all(observations):
    return 3 * observations[:, 2]


swing_all.batched = True


class Alternating:
    """One way and the other, from the first step of its episode on."""

    def __init__(self):
        self.steps = 0

    def __call__(self, observation):
        self.steps += 1
        return 1.0 if self.steps % 2 else -1.0


class Remembering:
    """A model whose state counts the steps of an episode."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        state = 0 if state is None or episode_start[0] else state + 1
        return np.array([state / 10], np.float32), state


model = PPO("MlpPolicy", gymnasium.make("Pendulum-v1"), n_steps=8, batch_size=8, device="cpu")
model.policy.action_net.weight.data *= 300  # which begin near 0


def broken(observation):
    return np.zeros(2)


def actions(policy, tmp_path, **how):
    data = package.collect(PENDULUM, tmp_path / "data", steps=60, policy=policy, **how)
    return data["action"][:].reshape(-1, 20), data


def test_a_function_acts_within_the_bounds_alone_or_on_all(tmp_path):
    made, data = actions(swing, tmp_path / "a")
    velocity = data["observation"][:].reshape(3, 20, 3)[..., 2]
    np.testing.assert_allclose(made, np.clip(3 * velocity, -2, 2), rtol=1e-6)
    assert (np.abs(made) == 2).any()
    np.testing.assert_array_equal(actions(f"{HERE}:swing_all", tmp_path / "b", num_envs=2)[0], made)


def test_what_is_remembered_begins_with_the_episode(tmp_path):
    made, _ = actions(Alternating, tmp_path / "a")
    np.testing.assert_array_equal(made, np.tile([1, -1], (3, 10)))
    made, _ = actions(Remembering(), tmp_path / "b")
    np.testing.assert_allclose(made, np.tile(np.arange(20) / 10, (3, 1)).clip(max=2), rtol=1e-6)


def test_a_model_of_stable_baselines3_returns_what_it_does_there():
    env, expected = gymnasium.make("Pendulum-v1", max_episode_steps=20), []
    for episode in range(2):
        (observation, _), total, ended = env.reset(seed=EVALUATION_SEED + episode), 0.0, False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, _, ended, _ = env.step(action)
            total += reward
        expected.append(total)
    returns = package.evaluate_policy(model, PENDULUM, episodes=2)
    np.testing.assert_allclose(returns, expected, rtol=1e-5)
    told = jbrep("evaluate-policy", f"{HERE}:model", *OPTIONS, "--episodes", 2, "--json")
    assert json.loads(told.stdout)["returns"] == returns.tolist()


def test_only_the_same_code_continues_a_data_set(tmp_path, monkeypatch):
    """Whether the code is in a module, which may change, or an object."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    source = "def act(observation):\n    return [observation[0]]\n"
    (tmp_path / "swinging.py").write_text(source)
    collect = ("collect", "--policy", "swinging:act", "--out", "data", *OPTIONS, "--steps")
    assert jbrep(*collect, 20).exit_code == 0
    assert jbrep(*collect, 40).exit_code == 0
    assert Dataset("data").manifest.settings.policy["name"].startswith("swinging:act ")
    (tmp_path / "swinging.py").write_text(source.replace("[0]", "[1]"))
    assert "other settings: policy.name" in mistake(*collect, 60)
    for there, now in ((lambda seen: seen[:1], lambda seen: seen[1:2]), (model, broken)):
        first, second = (find_policy(each, tmp_path, PENDULUM).settings() for each in (there, now))
        assert first != second
        assert find_policy(there, tmp_path, PENDULUM).settings() == first


@pytest.mark.parametrize(
    "policy", [broken, lambda seen: {}["sensor"], "uniform:x", 3.0, lambda seen: [np.nan]]
)
def test_what_cannot_act_is_refused(policy, tmp_path):
    with pytest.raises(InputError):
        package.collect(PENDULUM, tmp_path / "data", steps=20, policy=policy)


def test_your_own_needs_a_task_and_an_import(tmp_path):
    assert "--task" in mistake("evaluate-policy", f"{HERE}:swing")
    assert "not_there" in mistake("evaluate-policy", f"{HERE}:not_there", *OPTIONS)
    assert "cannot_be_imported" in mistake("evaluate-policy", "cannot_be_imported:act", *OPTIONS)


def test_parts_of_a_mixture_may_be_code(tmp_path):
    policy = find_policy(f"uniform:0.5+{HERE}:swing:0.5", tmp_path, PENDULUM)
    assert [part.settings()["kind"] for _, part in policy.parts] == ["uniform", "own"]
