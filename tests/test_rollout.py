"""Episodes to look at are the very ones that were stored or evaluated."""

from pathlib import Path

import numpy as np
import pytest
from behaviour import untrained

from jbrep.collecting import collect
from jbrep.dataset import Dataset, DataSettings
from jbrep.encoders import find
from jbrep.envs import Environments, describe
from jbrep.envs.recording import outcome
from jbrep.errors import InputError
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.tasks import TASKS
from jbrep.play.player import Player
from jbrep.play.rollout import replay
from jbrep.play.sources import find_episode, find_player
from jbrep.rl import Run, train
from jbrep.rl.files import EVALUATION_SEED, read_evaluations


def short(name):
    return describe(name, episode_steps=30)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    task = describe("face_direction", episode_steps=200)
    short = {"preset": "paper", "steps": 64, "evaluation_episodes": 2, "final_episodes": 2}
    train(Run.of(task, "a2c", encoder="dae-8", **short), folder)
    return folder


@pytest.fixture(scope="module")
def hopper(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hopper")
    collect(DataSettings(task=short("Hopper-v5"), policy={"kind": "uniform"}, steps=90), folder)
    return Dataset(folder)


def assert_stored(rollout, dataset, episode):
    """Whether it is what the data set has of an episode."""
    part = dataset.episode(episode)
    seen = np.concatenate((part["observation"], part.record["final_observation"][None]))
    np.testing.assert_array_equal(rollout.observation, seen)
    np.testing.assert_array_equal(rollout.action, part["action"])
    np.testing.assert_array_equal(rollout.reward, part["reward"])


@pytest.mark.parametrize("task", TASKS)
def test_replay_gives_the_stored_episode(task):
    dataset = Dataset(f"data/sample/{task}")
    rollout = replay(dataset, 1)
    assert_stored(rollout, dataset, 1)
    assert rollout.seed == dataset.episodes["seed"][1]
    assert (rollout.note, len(rollout.motion)) == ("", 1001)


def test_a_run_plays_the_episodes_that_it_was_evaluated_on(run):
    rows = read_evaluations(run)
    last = [row.episode_return for row in rows if row.step == rows[-1].step]
    played = [find_episode(str(run), episode).episode_return for episode in (0, 1)]
    np.testing.assert_allclose(played, last, atol=2e-3)


def test_an_episode_of_a_run_is_played_without_the_others_to_the_same_bits(run, monkeypatch):
    player = find_player(str(run))._replace(evaluation_batch=5)
    together = player.play(range(5))
    monkeypatch.setattr("jbrep.play.sources.find_player", lambda *_: player)
    for episode, expected in enumerate(together):
        alone = find_episode(str(run), episode)
        np.testing.assert_array_equal(alone.observation, expected.observation)
        np.testing.assert_array_equal(alone.action, expected.action)


def test_a_policy_before_training_is_the_one_that_was_evaluated_first(run):
    first = [e.episode_return for e in read_evaluations(run) if e.step == 0]
    before = untrained(run)
    player = Player("before", before.task, before.begin)
    np.testing.assert_allclose(player.returns(2), first, atol=2e-3)


def test_a_named_policy_plays_alone_as_among_others():
    task = describe("move_to_pose", episode_steps=200)
    alone = find_episode("heuristic", 1, task)
    returns = outcome(Environments(task, 2), HEURISTICS["move_to_pose"], EVALUATION_SEED).returns
    assert alone.episode_return == pytest.approx(returns[1], rel=1e-6)
    np.testing.assert_array_equal(find_player("heuristic", task).returns(2), returns)


def test_a_policy_plays_through_an_encoder():
    task = describe("face_direction", episode_steps=20)
    player = find_player("heuristic", task)
    decoding = [player.with_reconstruction(find(each, task)) for each in ("full", "pca-4")]
    direct, whole, blurred = (each.play([0])[0] for each in (player, *decoding))
    np.testing.assert_allclose(whole.action, direct.action, atol=1e-4)
    assert np.abs(blurred.action - direct.action).max() > 0.01


@pytest.mark.parametrize(("task", "joints"), [("Hopper-v5", 6), ("dm_control/cheetah-run-v0", 9)])
def test_the_motion_is_what_was_observed(task, joints):
    """Both observe all positions but the first, then all velocities."""
    rollout = find_episode("uniform", 1, short(task))
    assert 10 < len(rollout) <= 30
    assert rollout.terminated is (len(rollout) < 30)
    assert rollout.motion.qpos.shape == (len(rollout) + 1, joints)
    seen = np.concatenate((rollout.motion.qpos[:, 1:], rollout.motion.arrays["qvel"]), axis=1)
    np.testing.assert_allclose(seen.clip(-10, 10), rollout.observation, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rollout.motion.arrays["ctrl"][1:], rollout.action, rtol=1e-6)
    assert find_player("uniform", short(task)).returns(2)[1] == pytest.approx(
        rollout.episode_return, rel=1e-5, abs=1e-5
    )


def test_a_data_set_of_any_robot_is_replayed(hopper):
    for episode in (0, 1):
        rollout = replay(hopper, episode)
        assert (rollout.note, len(rollout.motion)) == ("", len(rollout) + 1)
        assert_stored(rollout, hopper, episode)


def test_what_comes_out_differently_or_can_t_be_simulated_is_shown_as_stored(hopper):
    spoilt, elsewhere = Dataset(hopper.folder), Dataset(hopper.folder)
    spoilt.episodes["seed"][0] += 1
    elsewhere.task = elsewhere.task.replace(id="Theirs/Hopper-v5")
    for dataset, why in ((spoilt, "differs"), (elsewhere, "Theirs/Hopper-v5")):
        rollout = replay(dataset, 0)
        assert (rollout.motion, why in rollout.note) == (None, True)
        assert_stored(rollout, hopper, 0)


def test_a_run_is_of_its_task_and_plays_it_for_longer_or_shorter(run):
    with pytest.raises(InputError, match="for face_direction, not for move_to_pose"):
        find_player(str(run), describe("move_to_pose"))
    player = find_player(str(run), describe("face_direction", episode_steps=20))
    assert [len(rollout) for rollout in player.play([0])] == [20]
