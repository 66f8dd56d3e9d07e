"""What a second reader of the code broke: each is a line, or works."""

import json
import sys
import time

import gymnasium
import numpy as np
import pytest
from command import jbrep, mistake, refused
from gymnasium.spaces import Box
from small import brief as settings
from small import write_again

from jbrep.collecting.policies import Heuristic
from jbrep.dataset import DamageError, Dataset
from jbrep.dataset.manifest import find_problems, open_shard
from jbrep.envs import describe
from jbrep.envs.autoreset import AutoresetEnvironments
from jbrep.envs.environments import Environments
from jbrep.errors import STEP_TIMEOUT, InputError
from jbrep.play.references import policies_of
from jbrep.records.record import from_plain
from jbrep.rl.normalization import Statistics
from jbrep.rl.overrides import overridden
from jbrep.studies.config import Study, as_study

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


gymnasium.register("SecondReading/Slow-v0", Slow, max_episode_steps=5)


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
    envs = Environments(describe("SecondReading/Slow-v0"), 6)
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
    good = Statistics.untrained(2).tensors
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
    envs = AutoresetEnvironments(describe("SecondReading/Slow-v0", missing="skip"), 1)
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
