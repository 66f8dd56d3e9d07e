"""Episodes to look at are the very ones that were stored or evaluated."""

from pathlib import Path

import numpy as np
import pytest

from jbrep.collect import collect
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import Settings
from jbrep.encoders import find
from jbrep.errors import InputError
from jbrep.jitterbug.heuristics import HEURISTICS, episode_returns
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import TASKS
from jbrep.rl import Run, train
from jbrep.rl.files import EVALUATION_SEED, read_evaluations
from jbrep.rl.policy import load_untrained
from jbrep.rollouts.rollout import replay
from jbrep.rollouts.sources import Player, find_episode, find_player


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    settings = Run(
        task="face_direction", algorithm="a2c", encoder="dae-8", steps=64, evaluation_episodes=2
    )
    train(settings, folder)
    return folder


@pytest.mark.parametrize("task", TASKS)
def test_replay_gives_the_stored_episode(task):
    dataset = Dataset(f"data/sample/{task}")
    rows, rollout = slice(1000, 2000), replay(dataset, 1)
    np.testing.assert_array_equal(
        rollout.observation[:-1].astype(np.float32), dataset["observation"][rows]
    )
    np.testing.assert_array_equal(
        rollout.observation[-1].astype(np.float32), dataset.episodes["final_observation"][1]
    )
    np.testing.assert_array_equal(rollout.reward.astype(np.float32), dataset["reward"][rows])
    np.testing.assert_array_equal(rollout.action, dataset["action"][rows])
    assert rollout.seed == dataset.episodes["seed"][1]
    assert rollout.time[-1] == pytest.approx(10)


@pytest.mark.parametrize("task", TASKS)
def test_terms_multiply_to_the_reward(task):
    rollout = replay(Dataset(f"data/sample/{task}"), 0)
    product = np.prod(list(rollout.terms.values()), axis=0)
    np.testing.assert_allclose(product[1:], rollout.reward, rtol=1e-12)


def test_a_run_plays_the_episodes_that_it_was_evaluated_on(run):
    rows = read_evaluations(run)
    last = [row.episode_return for row in rows if row.step == rows[-1].step]
    played = [find_episode(str(run), episode).reward.sum() for episode in (0, 1)]
    np.testing.assert_allclose(played, last, atol=2e-3)


def test_a_policy_before_training_is_the_one_that_was_evaluated_first(run):
    first = [e.episode_return for e in read_evaluations(run) if e.step == 0]
    before = load_untrained(run)
    player = Player("before", TASKS[before.task], before.begin)
    played = [rollout.reward.sum() for rollout in player.play([0, 1])]
    np.testing.assert_allclose(played, first, atol=2e-3)


def test_a_named_policy_plays_alone_as_among_others():
    alone = find_episode("heuristic", 1, "move_to_pose")
    returns = episode_returns("move_to_pose", HEURISTICS["move_to_pose"], 2, EVALUATION_SEED)
    assert alone.reward.sum() == pytest.approx(returns[1], abs=1e-9)


def test_the_target_turns_where_it_is_told():
    player = find_player("heuristic", "face_direction")
    (rollout,) = player.play([0], target_yaw=np.pi / 4)
    angles = rollout.readings.angle_to_target
    faces = np.arctan2(-rollout.rotation[:, 4], -rollout.rotation[:, 1])
    np.testing.assert_allclose(np.cos(angles), np.cos(np.pi / 4 - faces), atol=1e-12)
    assert np.abs(angles[-200:]).mean() < np.abs(angles[0])


def test_a_policy_plays_through_an_encoder():
    player = find_player("heuristic", "face_direction")
    direct, whole, blurred = (
        p.play([0])[0]
        for p in (
            player,
            *(player.with_reconstruction(find(e, "face_direction")) for e in ("identity", "pca-4")),
        )
    )
    np.testing.assert_allclose(whole.action[:20], direct.action[:20], atol=1e-4)
    assert np.abs(blurred.action[:20] - direct.action[:20]).max() > 0.01
    assert blurred.name == "heuristic on pca-4, decoded"
    with pytest.raises(InputError, match="move_to_pose"):
        player.with_reconstruction(find("pca-4", "move_to_pose"))


def test_an_episode_that_diverges_when_played_ends_before_it_does(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs there
    step, counts = Simulation.step, {}

    def spoil(simulation, action):
        counts[simulation] = counts.get(simulation, 0) + 1
        if counts[simulation] == 11:
            simulation.readings.qvel[1, 0] = np.nan
        return step(simulation, action)

    monkeypatch.setattr(Simulation, "step", spoil)
    played = find_player("heuristic", "move_to_pose").play([0, 1])
    assert [len(rollout) for rollout in played] == [1000, 10]
    start = TASKS["move_to_pose"].start(np.random.default_rng(EVALUATION_SEED + 1))
    np.testing.assert_array_equal(played[1].target_position, start.target_position)
    np.testing.assert_array_equal(played[1].target_quaternion, start.target_quaternion)
    returns = episode_returns("move_to_pose", HEURISTICS["move_to_pose"], 2, EVALUATION_SEED)
    np.testing.assert_allclose(returns, [rollout.reward.sum() for rollout in played])


def test_an_episode_that_diverged_ends_before_it_did(tmp_path):
    settings = Settings(task="face_direction", policy={"kind": "uniform"}, steps=1000)
    collect(settings, tmp_path / "d")
    dataset = Dataset(tmp_path / "d")
    dataset.episodes["length"][0] = 300
    rollout = replay(dataset, 0)
    assert len(rollout) == 300
    assert rollout.observation.shape == (301, 16)


@pytest.mark.parametrize(
    ("source", "episode", "task", "message"),
    [
        ("nowhere", 0, None, "nowhere is no data set, no run with a policy or checkpoint, and no"),
        ("heuristic", 0, None, "policy heuristic needs a --task"),
        ("heuristic", 0, "fly", "unknown task 'fly'"),
        ("heuristic", -1, "face_direction", "there is no episode -1"),
        ("constant:drive=2", 0, "face_direction", "the constant drive is 2.0"),
        ("data/sample/face_direction", 4, None, "has no episode 4: it has 4, from 0"),
        ("data/sample/face_direction", -1, None, "has no episode -1"),
    ],
)
def test_mistakes(source, episode, task, message):
    with pytest.raises(InputError, match=message):
        find_episode(source, episode, task)


def test_a_run_is_of_its_task(run):
    with pytest.raises(InputError, match="is a run of face_direction, not of move_to_pose"):
        find_player(str(run), "move_to_pose")
