"""Numbers that an environment tells in `info`: in evaluations, tables and reports."""

import json
import shutil

import numpy as np
import pytest
from command import in_this_process, jbrep, refused
from small import flip_bit

from jbrep.envs import describe
from jbrep.envs.environments import Environments
from jbrep.envs.infos import by_name, number_of, numbers_in, shares
from jbrep.envs.names import import_modules
from jbrep.reporting import report
from jbrep.reporting.findings import Findings
from jbrep.reporting.tables import read_tables
from jbrep.reporting.views import returns_tables
from jbrep.rl.files import EVALUATION_SEED, INFOS, Info, read_infos, read_run
from jbrep.studies.config import Study
from jbrep.studies.plan import Plan
from jbrep.studies.runner import run_study
from jbrep.studies.tables import RUN_INFOS, Return, RunInfo

import_modules(["environments"])
SCORED = "Sledges/Scored-v0"
EPISODES = 6
NAMES = ("is_success", "slid", "steps", "heat")


def told(episode):
    """What the environment tells of an episode of evaluation."""
    seed = EVALUATION_SEED + episode
    return (float(seed % 2), float(seed % 3 == 0), 6.0, seed % 5 / 7)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a short run, which went on after its first half, and what the command said."""
    folder = tmp_path_factory.mktemp("infos") / "run"
    command = ("rl", "--task", SCORED, "--algorithm", "a2c", "--set", "n_steps=8")
    command += ("--evaluate-every", 32, "--evaluation-episodes", 2)
    command += ("--final-episodes", EPISODES, "--out", folder, "--steps")
    for steps in (32, 64):
        done = jbrep(*command, steps)
        assert done.exit_code == 0, done.output
    return folder, done.stdout


def test_what_counts_as_a_number():
    assert [number_of(each) for each in (True, np.bool_(0), 3, np.int8(-3), np.float32(0.5))] == [
        *(1.0, 0.0, 3.0, -3.0, 0.5)
    ]
    others = (None, "1", np.zeros(1), np.zeros(()), np.nan, -np.inf, 1 << 60, 1j, np.str_("1"))
    assert [number_of(each) for each in others] == [None] * len(others)
    assert numbers_in({"a": 1, 2: 3, "b\n": 1, "": 1, "c" * 65: 1, "d": {"e": 1}}) == {"a": 1.0}


def test_shares_are_numbers_that_are_0_or_1():
    values = by_name([{"a": 1.0, "b": 0.5}, {"a": 0.0, "c": 1.0}, {"a": 0.0}])
    assert values == {"a": [1.0, 0.0, 0.0], "b": [0.5], "c": [1.0]}
    assert [*shares(values)] == ["a", "c"]


def test_an_episode_succeeds_if_any_of_its_steps_does():
    """Numbers are of each one's last step, and a success is forgotten at the next reset."""
    envs = Environments(describe(SCORED), 2)
    envs.reset([0, 1], [1, 2])
    assert envs.numbers == [{}, {}]
    for step in range(1, 7):
        envs.step(np.zeros((2, 3)))
        assert [each["is_success"] for each in envs.numbers] == [step >= 3, 0.0]
        assert [each["steps"] for each in envs.numbers] == [step, step]
    envs.reset([0], [2])
    assert [*map(dict.keys, envs.numbers)] == [{}.keys(), dict.fromkeys(NAMES).keys()]
    envs.step(np.zeros((2, 3)))
    assert [each["is_success"] for each in envs.numbers] == [0.0, 0.0]
    assert [each["steps"] for each in envs.numbers] == [1.0, 6.0]
    assert Environments(describe("face_direction"), 2).numbers == [{}, {}]


def test_a_run_keeps_them_and_says_the_shares(run):
    folder, said = run
    rows = [
        Info(step, episode, *each)
        for step, episodes in ((0, 2), (32, 2), (64, EPISODES))
        for episode in range(episodes)
        for each in zip(NAMES, told(episode), strict=True)
    ]
    assert read_infos(folder) == rows  # to the last bit
    assert "is_success 0.50 in 6 episodes; slid 0.33 in 6 episodes\n" in said
    assert INFOS in read_run(folder).tables


def test_evaluate_policy_says_them(run):
    folder, _ = run
    command = ("evaluate-policy", folder, "--episodes", 5, "--json")
    expected = [dict(zip(NAMES, told(episode), strict=True)) for episode in range(5)]
    assert json.loads(jbrep(*command).stdout)["infos"] == expected


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The folder of a tiny study, finished, and what its report says."""
    folder = tmp_path_factory.mktemp("infos") / "study"
    tiny = {"algorithms": ("a2c-paper",), "representations": ("full",), "seeds": (0, 1)}
    tiny |= {"steps": 40, "evaluate_every": 40}
    tiny |= {"evaluation_episodes": 1, "final_episodes": EPISODES}
    plan = Plan(Study(tasks=(SCORED, "Sledges/Sledge-v0"), **tiny), folder)
    assert run_study(plan, in_this_process, 1) == 0
    draw = report.study_plots
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "study_plots", lambda found: draw(found)[:1])
        done = jbrep("report", folder)
    assert done.exit_code == 0, done.output
    return folder, done.stdout


def test_a_study_has_them_in_a_table_of_its_own(study, tmp_path):
    folder, _ = study
    tables = read_tables(folder)
    assert tables.raw.infos == [
        RunInfo(SCORED, "a2c-paper", "full", seed, step, episode, *each)
        for seed in (0, 1)
        for step, episodes in ((0, 1), (40, EPISODES))
        for episode in range(episodes)
        for each in zip(NAMES, told(episode), strict=True)
    ]
    copied = shutil.copytree(folder, tmp_path / "copied")
    flip_bit(copied / RUN_INFOS, 300)
    assert RUN_INFOS in refused(read_tables, copied)


def test_reports_have_a_column_for_each_share(study):
    folder, _ = study
    scored, sledge = returns_tables(Findings.of(read_tables(folder)))
    heads = ("share of is_success", "share of slid")
    assert scored.header[-2:] == heads
    assert [row[-2:] for row in scored.rows] == [("0.50", "0.33"), *[("-", "-")] * 3]
    assert not {*heads} & {*sledge.header}
    assert heads[0] in (folder / "report.html").read_text()


def test_shares_are_of_last_evaluations_and_have_intervals(study):
    """A run that failed has none; four or more runs have an interval."""
    tables = read_tables(study[0])
    first, *_ = tables.raw.record.runs
    made = [first.replace(seed=seed) for seed in range(5)]
    made[4] = first.replace(seed=4, status="failed", reason="of heat")
    key = (SCORED, "a2c-paper", "full")
    returns = [Return(*key, seed, step, 0, 1.0) for seed in range(5) for step in (0, 40)]
    infos = [
        RunInfo(*key, seed, step, episode, "won", float(step == 40 and episode <= seed))
        for seed in range(5)
        for step in (0, 40)
        for episode in range(5)
    ]
    infos.append(RunInfo(*key, 3, 40, 0, "heat", 0.5))
    record = tables.raw.record.replace(runs=made)
    raw = tables.raw._replace(record=record, returns=returns, infos=infos)
    found = Findings.of(tables._replace(raw=raw))
    assert {run.seed: run.shares for run in found.runs} == {
        seed: {"won": (seed + 1) / 5} if seed < 4 else {} for seed in range(5)
    }
    (agents,) = next(g for g in found.groups if g.task == SCORED).agents
    assert agents.shares["won"] == pytest.approx((0.5, 0.16, 0.84), abs=0.005)
