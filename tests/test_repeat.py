"""Actions that are held for several control steps: in training, and by whoever plays the policy."""

import shutil

import numpy as np
import pytest
from small import settings

from jbrep.collecting import collect
from jbrep.dataset import Dataset
from jbrep.envs import describe
from jbrep.envs.autoreset import AutoresetEnvironments
from jbrep.envs.environments import Environments
from jbrep.play.sources import find_player, find_policy
from jbrep.rl import Run, train
from jbrep.rl.agent import evaluate
from jbrep.rl.files import EPISODES, POLICY, POLICY_ZIP, read_evaluations
from jbrep.rl.policy import load_run
from jbrep.rl.policy_file import read
from jbrep.rl.presets import sb3_class

TASK = describe("face_direction", episode_steps=50)
REPEAT = 4  # of which an episode isn't a multiple
BLOCKS = np.arange(50) // REPEAT


class Failing:
    """Physics that diverges in an environment at a step, and says so in that step alone."""

    def __init__(self, env, index, step):
        self._env, self._index, self._step, self._taken = env, index, step, 0

    def __getattr__(self, name):
        return getattr(self._env, name)

    def step(self, actions):
        self._taken += 1
        *moved, info = self._env.step(actions)
        diverged = np.zeros(self._env.num_envs, np.bool_)
        diverged[self._index] = self._taken == self._step
        moved[3] = moved[3] | diverged
        return *moved, {**info, "non_finite": diverged}


def test_a_held_action_is_the_same_as_its_steps_one_by_one():
    endless, envs = AutoresetEnvironments(TASK, 2, repeat=REPEAT), Environments(TASK, 2)
    np.testing.assert_array_equal(endless.reset([3, 4]), envs.reset(range(2), [3, 4]))
    random = np.random.default_rng(0)
    for step in range(13):
        action, reward = random.uniform(-1, 1, (2, 1)), np.zeros(2)
        for _ in range(min(REPEAT, 50 - REPEAT * step)):
            reward += envs.step(action).reward
        moved = endless.step(action)
        np.testing.assert_array_equal(moved.reward, reward)
        np.testing.assert_array_equal(moved.final, envs.observation)
        np.testing.assert_array_equal(moved.length, min(REPEAT * (step + 1), 50))
        np.testing.assert_array_equal(moved.ended, step == 12)
    usual = AutoresetEnvironments(TASK, 2)
    usual.reset([3, 4])
    for _ in range(50):
        following = usual.step(np.zeros((2, 1)))
    np.testing.assert_array_equal(moved.observation, following.observation)


def test_a_environment_that_diverges_while_an_action_is_held_waits_for_the_others():
    endless = AutoresetEnvironments(TASK, 2, repeat=REPEAT)
    endless.envs._batch = Failing(endless.envs._batch, index=1, step=6)
    endless.reset([0, 1])
    moved = [endless.step(np.ones((2, 1))) for _ in range(3)]
    assert [each.length.tolist() for each in moved] == [[4, 4], [8, 6], [12, 4]]
    assert [each.ended.tolist() for each in moved] == [[False] * 2, [False, True], [False] * 2]
    assert moved[1].end_info(1) == {"control_steps": 6, "non_finite": True}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with actions that are held."""
    small = {"net_arch": [8], "learning_starts": 1000, "num_envs": 2, "train_freq": 1}
    folder = tmp_path_factory.mktemp("repeat") / "run"
    small |= {"action_repeat": REPEAT, "n_steps": 3}
    played = {"evaluate_every": 100, "evaluation_episodes": 3, "final_episodes": 3}
    what = Run.of(TASK, "sac", "modern", small, steps=301, **played)
    assert train(what, folder).steps == 304  # 38 steps of two robots, of four control steps each
    return folder


def test_everything_counts_control_steps(run):
    rows = [line.split(",") for line in (run / EPISODES).read_text().splitlines()]
    assert rows[0] == ["step", "env", "return", "length", "diverged"]
    assert [(int(step), int(length)) for step, _, _, length, _ in rows[1:]] == [
        (step, 50)
        for step in (104, 104, 208, 208)  # 13 actions of two robots, the last cut short
    ]
    assert [*dict.fromkeys(each.step for each in read_evaluations(run))] == [0, 104, 200, 304]


def test_whoever_plays_the_policy_holds_its_actions(run, tmp_path):
    """Its evaluation, a player, a data set's collector, and stable-baselines3's file elsewhere."""
    last = [each.episode_return for each in read_evaluations(run) if each.step == 304]
    shutil.copy(run / POLICY, tmp_path / "kept.safetensors")
    for source in (run, tmp_path / "kept.safetensors"):
        player = find_player(str(source))
        np.testing.assert_allclose(player.returns(3), last, atol=6e-4)
        for rollout, expected in zip(player.play(range(3)), last, strict=True):
            assert rollout.episode_return == pytest.approx(expected, abs=1e-2)
            assert_held(rollout.action)
    assert read(run / POLICY).header.settings.hyperparameters.action_repeat == REPEAT
    assert load_run(run).settings.hyperparameters.action_repeat == REPEAT
    made = settings(task=TASK, steps=100, shard_episodes=1)
    policy = find_policy(str(run), tmp_path / "data", TASK)
    collect(made.replace(policy=policy.settings()), tmp_path / "data", policy=policy)
    for episode in np.split(Dataset(tmp_path / "data")["action"][:], 2):
        assert_held(episode)
    agent = sb3_class("sac").load(run / POLICY_ZIP)
    assert agent.action_repeat == REPEAT
    returns = evaluate(agent, Environments(TASK, 3), load_run(run).encoder, 3).returns
    np.testing.assert_allclose(returns, last, atol=6e-4)


def assert_held(action):
    """An episode's actions change with each block, and in none."""
    changes = np.diff(action[:, 0]) != 0
    np.testing.assert_array_equal(changes, np.diff(BLOCKS) > 0)
