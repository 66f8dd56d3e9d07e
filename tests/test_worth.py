"""What codes are worth: fitted Q-iteration, planning and small agents on codes."""

import dataclasses
import itertools
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.command import jbrep, mistake
from helpers.small import brief

from jbrep.collect import collect
from jbrep.dataset import Dataset
from jbrep.encoders import find
from jbrep.envs import Lanes, describe
from jbrep.envs.autoreset import AutoresetLanes
from jbrep.envs.lanes import EnvironmentFailedError
from jbrep.errors import InputError, Notice
from jbrep.evaluate.evaluation import Evaluation, Learned, Lost, Score
from jbrep.play.rollout import replay
from jbrep.play.sources import find_good_policy
from jbrep.records.document import read_document
from jbrep.records.lock import exclusive
from jbrep.report.evaluation import evaluation_text
from jbrep.report.worth import condition
from jbrep.rl.trainers import train_jobs
from jbrep.stats.intervals import Bounds
from jbrep.worth import agents, fitted, offline, planning
from jbrep.worth.fitted import Coded, Fourier, Trees
from jbrep.worth.offline import Ground, learned
from jbrep.worth.steps import Transitions, candidates, stored
from jbrep.worth.worth import _lanes, work_out


def line(seed=0, steps=4000):
    """A cart on a line of which the place is seen: actions move it, the middle is rewarded."""
    random = np.random.default_rng(seed)
    place = random.uniform(-1, 1, (steps, 1)).astype(np.float32)
    action = random.uniform(-1, 1, (steps, 1)).astype(np.float32)
    after = np.clip(place + 0.2 * action, -1, 1)
    ones = np.ones(steps)
    held = Transitions(place, action, 1 - np.abs(after[:, 0]), after, ones, ones > 0)
    return Coded(place, after, held)


WAYS = {
    "trees": lambda steps, task: fitted.q_iteration(Trees(steps), steps, 0.9, candidates(task)),
    "fourier": lambda steps, task: fitted.q_iteration(Fourier(steps), steps, 0.9, candidates(task)),
    "network": lambda steps, task: planning.planned(planning.network_model(steps), 0.9, 1),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_learned_goes_where_the_reward_is(way):
    choose = WAYS[way](line(), describe("face_direction"))
    places = np.array([[-0.8], [-0.5], [0.5], [0.8]], np.float32)
    assert np.sign(choose(places)).ravel().tolist() == [1, 1, -1, -1]


@pytest.mark.parametrize("way", ["trees", "network"])
@pytest.mark.parametrize("reward", [1.0, -1.0])
def test_by_constant_rewards_ends_are_avoided_or_sought(reward, way):
    """The left end of a line: avoided where each step earns one, sought where it costs one."""
    code, after, held = line()
    continues = (after[:, 0] > -1).astype(float)
    reward_of_each = np.full(len(code), reward)
    steps = Coded(
        code, after, Transitions(code, held.action, reward_of_each, after, continues, held.first)
    )
    choose = WAYS[way](steps, describe("face_direction"))
    assert np.sign(choose(np.array([[-0.9], [-0.75]], np.float32))).ravel().tolist() == [reward] * 2


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
        np.hstack((steps.code, noise[0])), np.hstack((steps.next_code, noise[1])), steps.held
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
    assert held.next_observation[-1].tobytes() == episode.record["final_observation"].tobytes()
    assert held.first.tolist() == [True] + 9 * [False]


def test_without_the_environment_returns_are_estimated(data):
    found = learned(find("full", data.task), Ground.of(data, None), "trees")
    assert found.again is None
    assert 0 <= found.score.value <= data.task.max_episode_steps


def test_an_estimated_return_is_that_of_the_policy():
    held, task = line().held, describe("face_direction").replace(max_episode_steps=100)
    as_it_is = SimpleNamespace(encode=lambda seen: seen)

    def estimated(unseen, direction):
        ground = Ground(task, 1, held, unseen, None)
        choose = lambda codes: direction * np.sign(codes)  # noqa: E731
        return offline._estimated(as_it_is, ground, choose).value

    assert estimated(
        Transitions(**{**held._asdict(), "reward": np.ones(len(held))}), 1
    ) == pytest.approx(100)
    assert estimated(held, -1) > estimated(held, 1) + 20  # to the middle, and away from it


@pytest.fixture(scope="module")
def told(data, tmp_path_factory):
    """What `jbrep evaluate --worth fitted` prints, and its folder."""
    out = tmp_path_factory.mktemp("told") / "a"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitted, "_TREES", 4)
        patch.setattr(fitted, "BACKUPS", 10)
        arguments = "--encoder", "pca-8", "--data", data.folder, "--out", out
        return jbrep("evaluate", *arguments, "--worth", "fitted").output, out


def known(told):
    return read_document(told[1] / "evaluation.json", Evaluation)


def test_evaluate_says_what_codes_are_worth(data, told):
    text, out = told
    worth = known(told).worth
    assert "Mean return of fitted Q-iteration with trees from steps that earn 0." in text
    assert set(worth.learned) == {"trees", "fourier"}
    assert set(worth.learned["trees"]) == {"full", "pca-8"}
    assert worth.learned["trees"]["full"].again is not None
    rewards = Ground.of(data, None).seen.reward
    assert worth.rewards == pytest.approx((rewards.mean(), rewards.std()), rel=1e-5)
    again = jbrep("evaluate", "--encoder", "pca-8", "--data", data.folder, "--out", out).output
    assert text.endswith(again)  # of what is known already nothing is lost
    assert known(told).worth == worth


def test_what_is_known_stays_and_the_rest_goes_on(data, told, tmp_path, monkeypatch):
    """Stopped after one code, the same call learns from the others alone."""
    whole, asked = known(told), []
    encoders = {"pca-8": find("pca-8", data.task)}
    some = whole.worth.learned["trees"]["full"]

    def stopped(encoder, ground, way):
        asked.append((way, encoder.name))
        if len(asked) == 2:
            raise SystemExit
        return some

    monkeypatch.setattr(offline, "learned", stopped)
    monkeypatch.setattr("jbrep.worth.worth.references_of", lambda task, episodes: {})
    arguments = encoders, data, tmp_path, ["fitted"]
    with pytest.raises(SystemExit):
        work_out(whole.replace(worth=None), *arguments)
    there = read_document(tmp_path / "evaluation.json", Evaluation)
    assert there.worth.learned == {"trees": {"full": some}}
    assert "isn't known yet" not in evaluation_text(there)
    assert set(work_out(there, *arguments).worth.learned) == {"trees", "fourier"}
    assert asked[2:] == [("trees", "pca-8"), ("fourier", "full"), ("fourier", "pca-8")]
    monkeypatch.setattr("jbrep.worth.worth._lanes", lambda data: nullcontext())
    with pytest.raises(InputError, match="returns that were played, and the environment can't be"):
        work_out(there, encoders, data, tmp_path, ["planning"])
    assert {*read_document(tmp_path / "evaluation.json", Evaluation).worth.learned} == {
        "trees",
        "fourier",
    }


def test_nobody_else_writes_while_codes_are_learned(data, told, tmp_path, monkeypatch):
    arguments = {"pca-8": find("pca-8", data.task)}, data, tmp_path, ["agent"]
    monkeypatch.setattr(agents, "learned", None)  # would fail
    with (
        exclusive(tmp_path / "evaluation.json", beside=True),
        pytest.raises(InputError, match="is being written by process"),
    ):
        work_out(known(told), *arguments)


def test_the_time_of_agents_that_were_stopped_counts(data, told, tmp_path, monkeypatch):
    clock, score = iter([0, 5, 10, 14]), Score(1.0, 0.5, 2.0)
    monkeypatch.setattr(time, "process_time", lambda: next(clock))

    def stopped(*given):
        raise SystemExit

    arguments = {"pca-8": find("pca-8", data.task)}, data, tmp_path, ["agent"]
    monkeypatch.setattr(agents, "learned", stopped)
    monkeypatch.setattr("jbrep.worth.worth.references_of", lambda task, episodes: {})
    with pytest.raises(SystemExit):
        work_out(known(told), *arguments)
    there = read_document(tmp_path / "evaluation.json", Evaluation)
    monkeypatch.setattr(agents, "learned", lambda codes, *given: dict.fromkeys(codes, score))
    worth = work_out(there, *arguments).worth
    assert list(worth.learned) == ["agent", "trees", "fourier"]  # the surest first, none lost
    assert worth.learned["agent"]["pca-8"] == Learned(score=score, seconds=4.5)


def test_agents_learn_from_codes(data, tmp_path, monkeypatch):
    monkeypatch.setattr(agents, "STEPS", 200)
    monkeypatch.setattr(agents, "RUNS", 1)
    codes = {
        label: find(label.partition(",")[0], data.task) for label in ("full", "pca-8, shipped")
    }
    returns = agents.learned(codes, data.task, tmp_path)
    assert all(0 <= low < mean < high <= 100 for mean, low, high in returns.values())


def test_agents_that_fail_count_with_the_least_return(data, tmp_path, monkeypatch):
    def failing(jobs, session):
        for job, record in train_jobs(jobs, session):
            yield job, record.replace(status="failed", reason="the loss is inf", policy_sha256=None)

    monkeypatch.setattr(agents, "STEPS", 200)
    monkeypatch.setattr(agents, "RUNS", 1)
    monkeypatch.setattr(agents, "train_jobs", failing)
    with pytest.warns(Notice, match="/full/seed-0 failed: the loss is inf"):
        returns = agents.learned({"full": find("full", data.task)}, data.task, tmp_path)
    assert returns["full"].value == 0


def test_an_agent_whose_environment_fails_ends_alone(data, tmp_path, monkeypatch):
    """Before it was evaluated once: it counts with the least return, if there is one."""
    reset, numbers = AutoresetLanes.reset, itertools.count()

    def fail_once(self, seeds):
        if next(numbers) == 0:
            raise EnvironmentFailedError("no power", 0)
        return reset(self, seeds)

    monkeypatch.setattr(agents, "STEPS", 200)
    monkeypatch.setattr(agents, "RUNS", 1)
    monkeypatch.setattr(AutoresetLanes, "reset", fail_once)
    codes = {label: find(label, data.task) for label in ("full", "pca-8")}
    with pytest.warns(Notice, match="/full/seed-0 failed: no power after 0 steps"):
        returns = agents.learned(codes, data.task, tmp_path)
    assert returns["full"].value == 0 < returns["pca-8"].value
    monkeypatch.setattr(agents, "bounds_of", lambda task: Bounds())
    with (
        pytest.warns(Notice, match="no power"),
        pytest.raises(InputError, match="/full/seed-0 has no return to count: no power"),
    ):
        agents.learned(codes, data.task, tmp_path)


def test_episodes_shorter_than_an_action_is_held_teach_nothing_more(data):
    with Lanes(data.task, offline.EPISODES) as lanes:
        ground = dataclasses.replace(Ground.of(data, lanes), hold=data.task.max_episode_steps + 1)
        found = learned(find("pca-8", data.task), ground, "trees")
    assert found.again == found.score


def returns_of(told, **learned):
    """The evaluation, with other returns: by way, of the full observation and of pca-8."""
    evaluation = known(told)
    means = {
        way: {
            label: Learned(score=Score(mean, mean - 5, mean + 5), seconds=1.0)
            for label, mean in zip(("full", "pca-8"), each, strict=True)
        }
        for way, each in learned.items()
    }
    worth = evaluation.worth.replace(learned=means, references={"standing still": 30.0})
    lost = Lost(name="motor_velocity", kept=0.1, need=0.9)
    loses = {"full": (), "pca-8": (lost,)}
    codes = {name: each.replace(loses=loses[name]) for name, each in evaluation.encoders.items()}
    return evaluation.replace(
        worth=worth, encoders=codes, needs=evaluation.needs | {"motor_velocity": 0.9}
    )


@pytest.mark.parametrize(
    ("learned", "first", "line"),
    [
        ({"agent": (90, 88)}, "Take pca-8: by small agents, the smallest of those", "88 [83, 93]"),
        ({"agent": (90, 82)}, "Take the full observation: by small agents", "82 [77, 87]"),
        ({"agent": (25, 20)}, "Nothing can be said of the codes: by small agents, none", "20"),
        (
            {"trees": (90, 70), "fourier": (88, 40)},
            "Perhaps take the full observation: by fitted",
            "70 [65, 75]; lacks motor_velocity (0.10); ill-conditioned: trees make 70 of it",
        ),
    ],
)
def test_a_code_is_recommended_with_reasons(told, learned, first, line):
    text = evaluation_text(returns_of(told, **learned))
    assert text.startswith(first)
    assert f"\npca-8 {line}" in text
    assert "lacks motor_velocity (0.10)" in text


def test_of_a_constant_reward_nothing_can_be_learned(told):
    evaluation = returns_of(told, trees=(90, 50))
    constant = evaluation.replace(worth=evaluation.worth.replace(rewards=(0.0, 0.0)))
    ending = constant.replace(worth=constant.worth.replace(ends=True))
    assert evaluation_text(ending).startswith("Perhaps take the full observation")
    assert "didn't follow it: ask for --worth agent" in " ".join(evaluation_text(ending).split())
    text = evaluation_text(constant)
    assert text.startswith("Every reward of the data is 0: what codes are worth can't be learned")
    assert "90" not in text.partition("\n\n")[0]
    by_agents = returns_of(told, agent=(90, 50))
    worth = by_agents.worth.replace(rewards=(0.0, 0.0))
    assert evaluation_text(by_agents.replace(worth=worth)).startswith("Take the full observation")


def test_a_code_that_hardly_varies_in_a_direction_is_ill_conditioned(told):
    units = known(told).encoders["pca-8"].latent_units
    codes = np.random.default_rng(0).normal(size=(1000, 3)) @ np.diag([1, 300, 2])
    mixed = codes @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    correlation = tuple(map(tuple, np.corrcoef(mixed.T).tolist()))
    few = units.replace(
        variance=tuple(mixed.var(axis=0).tolist()), correlation=correlation, dead=()
    )
    assert condition(few) == pytest.approx(np.linalg.cond(np.cov(mixed.T)) ** 0.5, rel=1e-3)
    with_dead = few.replace(
        variance=(*few.variance, 0.0),
        correlation=(*((*row, None) for row in correlation), (None,) * 4),
        dead=(3,),
    )
    assert condition(with_dead) == pytest.approx(condition(few))


def test_own_rewards_are_never_compared_with_those_of_the_environment(data, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("jbrep.envs.names._imported", [])  # other tests' workers lack it
    (tmp_path / "turned.py").write_text("def reward(seen, done):\n    return 0 * seen[:, 0] + 7\n")
    own = tmp_path / "own"
    jbrep("data", "derive", data.folder, "--reward", "turned:reward", "--out", own)
    with _lanes(Dataset(own)) as lanes:
        assert lanes is None
    arguments = "--encoder", "pca-8", "--data", own, "--worth", "agent", "--out", tmp_path / "c"
    assert "gives other rewards" in mistake("evaluate", *arguments)
    assert not (tmp_path / "c").exists()  # nothing takes time before
    assert replay(Dataset(own), 0).motion  # it is filmed and shown as the robot's
    assert find_good_policy(None, data.task, own_rewards=True) is None
    assert find_good_policy("heuristic", data.task, own_rewards=True).states is None


def test_steps_are_held_out_as_from_encoders(data):
    rows, episodes = data.split(), data.split_episodes()
    lengths = data.episodes["length"]
    at = np.repeat(np.arange(len(lengths)), lengths)
    assert [np.unique(at[each]).tolist() for each in rows] == [e.tolist() for e in episodes]
    first = {each.tobytes() for each in Ground.of(data, None).unseen.observation}
    assert first <= {each.tobytes() for each in data["observation"][rows.test]}
