"""What codes are worth: small agents on codes."""

import itertools
import time

import numpy as np
import pytest
from helpers.command import jbrep, mistake
from helpers.small import brief
from jbrep.rl.trainers import train_jobs

from jbrep import worth
from jbrep.collect import collect
from jbrep.dataset import Dataset
from jbrep.encoders import find
from jbrep.envs.autoreset import AutoresetLanes
from jbrep.envs.lanes import EnvironmentFailedError
from jbrep.envs.task import Task
from jbrep.errors import InputError, Notice
from jbrep.evaluate.evaluation import Evaluation, Lost, Score, Worth
from jbrep.play.rollout import replay
from jbrep.play.sources import find_good_policy
from jbrep.records.document import read_document
from jbrep.records.lock import exclusive
from jbrep.report.evaluation import evaluation_text
from jbrep.report.worth import condition, conditioning
from jbrep.rl.files import read_evaluations
from jbrep.worth import add_worth, learned


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("worth") / "data"
    collect(brief(), folder)
    return Dataset(folder)


@pytest.fixture
def small(monkeypatch):
    """One agent a code, of 200 steps."""
    monkeypatch.setattr(worth, "STEPS", 200)
    monkeypatch.setattr(worth, "RUNS", 1)


@pytest.fixture(scope="module")
def told(data, tmp_path_factory):
    """What `jbrep evaluate --agents` prints, and its folder."""
    out = tmp_path_factory.mktemp("told") / "a"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worth, "STEPS", 200)
        patch.setattr(worth, "RUNS", 1)
        arguments = "--encoder", "pca-8", "--data", data.folder, "--out", out
        return jbrep("evaluate", *arguments, "--agents").output, out


def known(told):
    return read_document(told[1] / "evaluation.json", Evaluation)


def test_evaluate_says_what_agents_return(data, told, monkeypatch):
    text, out = told
    found = known(told).worth
    assert "Mean return of small agents, 1 of 200 steps each, in 20 episodes" in text
    assert set(found.returns) == {"full", "pca-8"}
    assert set(found.references) >= {"standing still", "random"}
    assert found.seconds > 0
    monkeypatch.setattr(worth, "learned", None)  # would fail
    arguments = "evaluate", "--encoder", "pca-8", "--data", data.folder, "--out", out
    for again in (arguments, (*arguments, "--agents")):  # of what is known nothing is lost
        assert text.endswith(jbrep(*again).output)
        assert known(told).worth == found


def test_nobody_else_writes_while_agents_learn(data, told, tmp_path, monkeypatch):
    monkeypatch.setattr(worth, "learned", None)  # would fail
    with (
        exclusive(tmp_path / "evaluation.json", beside=True),
        pytest.raises(InputError, match="is being written by process"),
    ):
        add_worth(known(told), {"pca-8": find("pca-8", data.task)}, data.task, tmp_path)


def test_the_time_of_agents_that_were_stopped_counts(data, told, tmp_path, monkeypatch):
    clock, score = iter([0, 5, 10, 14]), Score(1.0, 0.5, 2.0)
    monkeypatch.setattr(time, "process_time", lambda: next(clock))

    def stopped(*given):
        raise SystemExit

    arguments = {"pca-8": find("pca-8", data.task)}, data.task, tmp_path
    monkeypatch.setattr(worth, "learned", stopped)
    monkeypatch.setattr(worth, "references_of", lambda task, episodes: {})
    with pytest.raises(SystemExit):
        add_worth(known(told).replace(worth=None), *arguments)
    there = read_document(tmp_path / "evaluation.json", Evaluation)
    assert "small agents" not in evaluation_text(there)  # as if there were none
    monkeypatch.setattr(worth, "learned", lambda codes, *given: dict.fromkeys(codes, score))
    found = add_worth(there, *arguments).worth
    assert found == read_document(tmp_path / "evaluation.json", Evaluation).worth
    assert (found.returns["pca-8"], found.seconds) == (score, 9.0)


@pytest.mark.usefixtures("small")
def test_agents_learn_from_codes(data, tmp_path):
    codes = {
        label: find(label.partition(",")[0], data.task) for label in ("full", "pca-8, shipped")
    }
    returns = learned(codes, data.task, tmp_path)
    assert all(0 <= low < mean < high <= 100 for mean, low, high in returns.values())


@pytest.mark.usefixtures("small")
def test_agents_that_fail_count_with_the_least_return(data, tmp_path, monkeypatch):
    def failing(jobs, session):
        for job, record in train_jobs(jobs, session):
            yield job, record.replace(status="failed", reason="the loss is inf", policy_sha256=None)

    monkeypatch.setattr(worth, "train_jobs", failing)
    with pytest.warns(Notice, match="/full/seed-0 failed: the loss is inf"):
        returns = learned({"full": find("full", data.task)}, data.task, tmp_path)
    assert returns["full"].value == 0


@pytest.mark.usefixtures("small")
def test_an_agent_whose_environment_fails_ends_alone(data, tmp_path, monkeypatch):
    """Before it was evaluated once: it counts with the least return, if there is one."""
    reset, numbers = AutoresetLanes.reset, itertools.count()

    def fail_once(self, seeds):
        if next(numbers) == 0:
            raise EnvironmentFailedError("no power")
        return reset(self, seeds)

    monkeypatch.setattr(AutoresetLanes, "reset", fail_once)
    codes = {label: find(label, data.task) for label in ("full", "pca-8")}
    with pytest.warns(Notice, match="/full/seed-0 failed: no power after 0 steps"):
        returns = learned(codes, data.task, tmp_path)
    assert returns["full"].value == 0 < returns["pca-8"].value
    monkeypatch.setattr(Task, "return_floor", None)
    with pytest.warns(Notice, match="no power"):
        returns = learned(codes, data.task, tmp_path)
    seen = [each.episode_return for each in read_evaluations(tmp_path / "pca-8/seed-0")]
    assert returns["full"].value == pytest.approx(min(seen))  # the worst that the other had
    with (
        pytest.warns(Notice, match="no power"),
        pytest.raises(InputError, match="/full/seed-0 has no return to count: no power"),
    ):
        learned({"full": codes["full"]}, data.task, tmp_path)


def returns_of(told, full, pca, half=5):
    """The evaluation, with other returns."""
    evaluation = known(told)
    returns = {
        label: Score(mean, mean - half, mean + half)
        for label, mean in (("full", full), ("pca-8", pca))
    }
    references = {"standing still": 30.0}
    found = Worth(runs=2, steps=100, episodes=20, returns=returns, references=references)
    lost = Lost(name="motor_velocity", kept=0.1, need=0.9)
    loses = {"full": (), "pca-8": (lost,)}
    codes = {name: each.replace(loses=loses[name]) for name, each in evaluation.encoders.items()}
    return evaluation.replace(
        worth=found, encoders=codes, needs=evaluation.needs | {"motor_velocity": 0.9}
    )


@pytest.mark.parametrize(
    ("returns", "first", "line"),
    [
        ((90, 88), "Take pca-8: by small agents, the smallest of those", "88 [83, 93]"),
        ((90, 84), "Take pca-8: by small agents, the smallest of those", "84 [79, 89]"),
        ((90, 82), "Take the full observation: by small agents", "82 [77, 87]"),
        ((33, 20), "Nothing can be said of the codes: by small agents, none", "20 [15, 25]"),
        ((33, 20, 2), "Take the full observation: by small agents", "20 [18, 22]"),
        ((82, 90), "Take pca-8: by small agents, it is worth the most.", "90 [85, 95]"),
        ((25, 20), "Nothing can be said of the codes: by small agents, none", "20"),
    ],
)
def test_a_code_is_recommended_with_reasons(told, returns, first, line):
    text = evaluation_text(returns_of(told, *returns))
    assert text.startswith(first)
    assert f"\npca-8 {line}" in text
    assert "lacks motor_velocity (0.10)" in text


def test_a_code_that_hardly_varies_in_a_direction_is_ill_conditioned(told):
    units = known(told).encoders["pca-8"].latent_units
    codes = np.random.default_rng(0).normal(size=(1000, 3)) @ np.diag([1, 300, 2])
    mixed = codes @ np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    correlation = tuple(map(tuple, np.corrcoef(mixed.T).tolist()))
    few = units.replace(
        variance=tuple(mixed.var(axis=0).tolist()), correlation=correlation, dead=()
    )
    assert conditioning(few).startswith("ill-conditioned: one direction varies ")
    apart = few.replace(variance=(1.0, 4.0, 2.0), correlation=tuple(map(tuple, np.eye(3).tolist())))
    assert conditioning(apart) == ""
    assert condition(few) == pytest.approx(np.linalg.cond(np.cov(mixed.T)) ** 0.5, rel=1e-3)
    with_dead = few.replace(
        variance=(*few.variance, 0.0),
        correlation=(*((*row, None) for row in correlation), (None,) * 4),
        dead=(3,),
    )
    assert condition(with_dead) == pytest.approx(condition(few))


def test_agents_are_refused_where_none_can_be_trained(data, tmp_path, monkeypatch):
    def missing(task, count):
        raise ModuleNotFoundError("No module named 'robot'")

    monkeypatch.setattr(worth, "Lanes", missing)
    arguments = "--encoder", "pca-8", "--data", data.folder, "--agents", "--out", tmp_path / "a"
    assert "can't be made here: no agent can be trained" in mistake("evaluate", *arguments)
    assert not (tmp_path / "a").exists()


def test_own_rewards_are_never_compared_with_those_of_the_environment(data, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("jbrep.envs.names._imported", [])  # other tests' workers lack it
    (tmp_path / "turned.py").write_text("def reward(seen, done):\n    return 0 * seen[:, 0] + 7\n")
    own = tmp_path / "own"
    jbrep("data", "derive", data.folder, "--reward", "turned:reward", "--out", own)
    arguments = "--encoder", "pca-8", "--data", own, "--agents", "--out", tmp_path / "c"
    assert "gives other rewards" in mistake("evaluate", *arguments)
    assert not (tmp_path / "c").exists()  # nothing takes time before
    assert replay(Dataset(own), 0).motion  # it is filmed and shown as the robot's
    assert find_good_policy(None, data.task, own_rewards=True) is None
    assert find_good_policy("heuristic", data.task, own_rewards=True).states is None
