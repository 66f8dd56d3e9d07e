"""What codes are worth: fitted Q-iteration, planning and small agents on codes."""

import numpy as np
import pytest
from helpers.command import jbrep, mistake
from helpers.small import brief

from jbrep.collect import collect
from jbrep.dataset import Dataset
from jbrep.encoders import find
from jbrep.envs import describe
from jbrep.evaluate.evaluation import Evaluation
from jbrep.records.document import read_document
from jbrep.worth import fitted, planning
from jbrep.worth.fitted import Coded, Fourier, Trees
from jbrep.worth.offline import Ground, learned
from jbrep.worth.steps import Held, choices, stored
from jbrep.worth.worth import _lanes


def line(seed=0, steps=4000):
    """A cart on a line of which the place is seen: actions move it, the middle is rewarded."""
    random = np.random.default_rng(seed)
    place = random.uniform(-1, 1, (steps, 1)).astype(np.float32)
    action = random.uniform(-1, 1, (steps, 1)).astype(np.float32)
    after = np.clip(place + 0.2 * action, -1, 1)
    ones = np.ones(steps)
    held = Held(place, action, 1 - np.abs(after[:, 0]), after, ones, ones > 0)
    return Coded(place, after, held)


WAYS = {
    "trees": lambda steps, task: fitted.q_iteration(Trees(steps), steps, 0.9, choices(task)),
    "fourier": lambda steps, task: fitted.q_iteration(Fourier(steps), steps, 0.9, choices(task)),
    "network": lambda steps, task: planning.planned(planning.network_model(steps), 0.9, 1),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_learned_goes_where_the_reward_is(way):
    choose = WAYS[way](line(), describe("face_direction"))
    places = np.array([[-0.8], [-0.5], [0.5], [0.8]], np.float32)
    assert np.sign(choose(places)).ravel().tolist() == [1, 1, -1, -1]


def test_a_code_of_noise_teaches_nothing():
    steps = line()
    random = np.random.default_rng(1).normal(size=(2, 4000, 1)).astype(np.float32)
    choose = WAYS["trees"](Coded(*random, steps.held), describe("face_direction"))
    places = np.linspace(-1, 1, 200, dtype=np.float32)[:, None]
    right = np.sign(choose(places)).ravel() == -np.sign(places).ravel()
    assert right.mean() < 0.75


def test_fourier_features_hide_what_a_scale_hides_and_trees_do_not():
    """Beside a unit of noise ten thousand times as large, one of them can't see the place."""
    steps = line()
    noise = np.random.default_rng(2).normal(size=(2, 4000, 1)).astype(np.float32) * 1e4
    badly = Coded(
        np.hstack((steps.code, noise[0])), np.hstack((steps.following, noise[1])), steps.held
    )
    places = np.array([[p, n] for p in (-0.8, 0.8) for n in (-9e3, 0.0, 9e3)], np.float32)
    right = {
        way: (
            np.sign(WAYS[way](badly, describe("face_direction"))(places)).ravel()
            == -np.sign(places[:, 0])
        ).mean()
        for way in ("trees", "fourier")
    }
    assert right["trees"] == 1 > right["fourier"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("worth") / "data"
    collect(brief(), folder)
    return Dataset(folder)


def test_held_steps_are_means_of_control_steps(data):
    held = stored(data, np.array([2]), 10, 1000)
    episode = data.episode(2)
    assert len(held) == 10
    assert held.reward[3] == pytest.approx(episode["reward"][30:40].mean(dtype=np.float64))
    assert held.action[3] == pytest.approx(episode["action"][30:40].mean(axis=0), abs=1e-6)
    assert held.observation[3].tobytes() == episode["observation"][30].tobytes()
    assert held.following[-1].tobytes() == episode.record["final_observation"].tobytes()
    assert held.first.tolist() == [True] + 9 * [False]


def test_without_the_environment_returns_are_estimated(data):
    found = learned(find("full", data.task), Ground.of(data, None), "trees")
    assert found.again is None
    assert 0 <= found.score.value <= data.task.max_episode_steps


def test_evaluate_says_what_codes_are_worth(data, tmp_path):
    arguments = "--encoder", "pca-8", "--data", data.folder, "--worth", "fitted"
    told = jbrep("evaluate", *arguments, "--out", tmp_path / "a").output
    assert "Mean returns of 20 episodes" in told
    kept = read_document(tmp_path / "a" / "evaluation.json", Evaluation).worth
    assert set(kept.learned) == {"trees", "fourier"}
    assert set(kept.learned["trees"]) == {"full", "pca-8"}
    assert kept.learned["trees"]["full"].again is not None
    again = jbrep(*("evaluate", *arguments[:4]), "--out", tmp_path / "a").output
    assert "Mean returns of 20 episodes" in again  # of what is known already nothing is lost
    assert read_document(tmp_path / "a" / "evaluation.json", Evaluation).worth == kept


def test_own_rewards_are_never_compared_with_those_of_the_environment(data, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("jbrep.envs.names._imported", [])  # other tests' workers lack it
    (tmp_path / "turned.py").write_text("def reward(seen, done):\n    return 0 * seen[:, 0] + 7\n")
    own = tmp_path / "own"
    jbrep("data", "derive", data.folder, "--reward", "turned:reward", "--out", own)
    with _lanes(Dataset(own)) as lanes:
        assert lanes is None
    arguments = "--encoder", "pca-8", "--data", own, "--worth", "agent", "--out", tmp_path / "c"
    assert "gives other rewards" in jbrep("evaluate", *arguments).output


def test_steps_are_held_out_as_from_encoders(data):
    rows, episodes = data.split(), data.split_episodes()
    lengths = data.episodes["length"]
    at = np.repeat(np.arange(len(lengths)), lengths)
    assert [np.unique(at[each]).tolist() for each in rows] == [e.tolist() for e in episodes]
    first = {each.tobytes() for each in Ground.of(data, None).unseen.observation}
    assert first <= {each.tobytes() for each in data["observation"][rows.test]}


def test_an_unknown_worth_is_told_in_a_line(data, tmp_path):
    arguments = "--encoder", "pca-8", "--data", data.folder, "--worth", "gold"
    told = mistake("evaluate", *arguments, "--out", tmp_path / "b")
    assert "agent, fitted, planning" in told
    assert not (tmp_path / "b").exists()
