"""Settings other than a preset's: their names and values, networks, and running normalisation."""

import json
import tomllib

import numpy as np
import pytest
import torch
from behaviour import untrained
from small import assert_same_files, stopping

from jbrep.encoders import find
from jbrep.envs import describe
from jbrep.envs.environments import Environments
from jbrep.envs.recording import outcome
from jbrep.errors import InputError
from jbrep.records.document import toml_text
from jbrep.rl import Run, StoppedError, train
from jbrep.rl.agent import evaluate, make_agent, make_env, statistics_of
from jbrep.rl.files import EVALUATION_SEED, POLICY, POLICY_ZIP, read_evaluations
from jbrep.rl.learner import Learner, read_preset
from jbrep.rl.overrides import overridden
from jbrep.rl.policy import load_run
from jbrep.rl.presets import sb3_class
from jbrep.studies.config import as_study, read_study
from jbrep.studies.plan import Plan, read_plan

TASK = describe("Pendulum-v1", episode_steps=20)
PINK = {"kind": "coloured", "beta": 1, "sigma": 0.2}
HELD = {"action_repeat": 3, "n_steps": 2}
SMALL = {"net_arch": [8], "learning_starts": 10, "train_freq": 5, "batch_size": 8}
QUICK = {"task": TASK, "preset": "modern", "steps": 60}
QUICK |= {"evaluation_episodes": 2, "final_episodes": 2}
SAC_RUN = Run.of(**QUICK, overrides={**SMALL, "normalize": True})


def agent_of(algorithm, overrides, preset="modern"):
    chosen = overridden(algorithm, preset, overrides)
    env = make_env(TASK, chosen, 0, find("full", TASK))
    return make_agent(algorithm, chosen, env, 0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("settings") / "run"
    train(SAC_RUN, folder)
    return folder


def test_settings_reach_the_agent():
    agent = agent_of(
        "sac",
        {
            "learning_rate": "linear:1e-3",
            "net_arch": {"pi": [8], "qf": [6, 4]},
            "activation_fn": "silu",
            "noise": {"kind": "normal", "sigma": 0.1},
            "train_freq": [2, "step"],
            "num_envs": 2,
            "n_critics": 3,
            "optimizer_kwargs": {"betas": [0.5, 0.9]},
        },
    )
    assert [agent.lr_schedule(left) for left in (1, 0.5, 0)] == [1e-3, 5e-4, 0]
    assert agent.actor.latent_pi[0].out_features == 8
    assert isinstance(agent.actor.latent_pi[1], torch.nn.SiLU)
    assert [m.out_features for m in agent.critic.q_networks[2] if hasattr(m, "bias")] == [6, 4, 1]
    assert (agent.n_envs, agent.train_freq.frequency) == (2, 2)
    assert agent.action_noise._sigma == 0.1
    assert agent.actor.optimizer.param_groups[0]["betas"] == (0.5, 0.9)
    assert agent.learning_starts == 1000  # of the preset, as before
    assert agent_of("sac", {"noise": "none"}, "paper").action_noise is None


@pytest.mark.parametrize(
    ("algorithm", "settings", "named"),
    [
        ("sac", {"lr": 1}, "learning_rate"),
        ("sac", {"batch_size": 2.5}, "batch_size"),
        ("sac", {"gamma": float("nan")}, "no finite number"),
        ("ppo", {"net_arch": {"pi": [8], "qf": [8]}}, "net_arch"),
        ("sac", {"noise": {"kind": "coloured", "beta": 2.5}}, r"noise\.beta"),
        ("sac", {"optimizer_kwargs": {"lr": 1}}, r"optimizer_kwargs\.lr"),
        ("sac", {"ent_coef": "often"}, "often"),
        ("sac", {"train_freq": [1, "episode"], "num_envs": 2}, "num_envs"),
        ("sac", {"net_arch": [1024] * 4, "n_critics": 8}, "bytes"),
    ],
)
def test_what_a_setting_can_not_be(algorithm, settings, named, tmp_path):
    with pytest.raises(InputError, match=named):
        train(Run.of(**QUICK, algorithm=algorithm, overrides=settings), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def preset(algorithm, overrides):
    """A preset file."""
    learner = Learner.given(algorithm, "modern", overrides)
    return toml_text({algorithm: {"base": learner.preset, **learner.overrides}})


def test_a_preset_file(tmp_path):
    path = tmp_path / "mine.toml"
    settings = {"net_arch": {"pi": [8], "qf": [4]}, "noise": "none", "gamma": 0.9}
    path.write_text(preset("sac", settings) + "[ppo]\ngama = 1\n")
    assert read_preset(path, "sac") == ("modern", settings)
    run = Run.of(task=TASK, algorithm="sac", preset=str(path), overrides={"gamma": 0.8})
    assert (run.learner.preset, run.learner.overrides) == ("modern", {**settings, "gamma": 0.8})
    assert run.learner.name == "sac-modern+mine+gamma=0.8"
    for algorithm, message in (("ppo", r"mine\.toml, \[ppo\].*gama"), ("td3", r"\[td3\]")):
        with pytest.raises(InputError, match=message):
            Run.of(task=TASK, algorithm=algorithm, preset=str(path))


def test_learners_of_tables():
    assert Learner.of_table("ddpg", {}) == Learner.of("ddpg")
    assert Learner.of_table("sac-wide", {}).hyperparameters.num_envs == 64
    mine = Learner.of_table("my-sac", {"base": "sac-modern", "gamma": 0.9})
    assert (mine.algorithm, mine.preset, mine.overrides) == ("sac", "modern", {"gamma": 0.9})
    assert Learner.of_table("my-sac", mine.table) == mine


@pytest.mark.parametrize(
    ("name", "table", "named"),
    [
        ("mine", {"gamma": 0.9}, "mine"),
        ("sac", {"gamma": 0.9}, "preset's name"),
        ("mine", {"base": "sac-modern", "preset": "paper"}, "preset"),
        ("a/b", {"base": "sac"}, "a/b"),
        ("mine", {"base": 3}, "base"),
        ("mine", {"base": "sac", "draws": {"tau": []}}, "lists"),
        ("mine", {"base": "sac", "draws": {"tau": [0.1, -1]}}, "tau"),
    ],
)
def test_a_table_that_is_no_learner(name, table, named):
    with pytest.raises(InputError, match=named):
        Learner.of_table(name, table)


def resumed(run, folder):
    """The run in a folder, stopped once on the way."""
    with pytest.raises(StoppedError):
        train(run, folder, stopping(30))
    assert load_run(folder).step
    train(run, folder)
    return folder


@pytest.mark.parametrize(
    ("algorithm", "overrides"),
    [
        ("tqc", {**SMALL, "learning_rate": "linear:0.01", "num_envs": 2, "noise": PINK, **HELD}),
        ("crossq", {**SMALL, "renorm_warmup_steps": 2}),
        ("ppo", {"n_steps": 10, "batch_size": 20, "num_envs": 2, "normalize": True}),
    ],
)
def test_a_stopped_run_resumes_to_the_same_bytes_whatever_its_settings(
    algorithm, overrides, tmp_path
):
    run = Run.of(**QUICK, algorithm=algorithm, overrides=overrides)
    train(run, tmp_path / "whole")
    resumed(run, tmp_path / "stopped")
    names = "episodes.csv", "evaluations.csv", POLICY
    assert_same_files(tmp_path / "whole", tmp_path / "stopped", *names)
    there = sb3_class(algorithm).load(tmp_path / "whole" / POLICY_ZIP, device="cpu")
    assert getattr(there, "action_noise", None) is None  # whose class only jbrep has
    check_last_evaluation(tmp_path / "whole")


def check_last_evaluation(folder):
    """The loaded policy plays the run's last evaluation."""
    trained = load_run(folder)
    envs = Environments(TASK, 2)
    returns = outcome(envs, trained.begin(TASK, [0, 1]), EVALUATION_SEED).returns
    last = [row.episode_return for row in read_evaluations(folder) if row.step > 0][-2:]
    np.testing.assert_allclose(returns, last, atol=6e-4)


def test_normalisation_is_resumed_evaluated_and_read_back(run, tmp_path):
    resumed(SAC_RUN, tmp_path / "stopped")
    assert (tmp_path / "stopped" / POLICY).read_bytes() == (run / POLICY).read_bytes()
    check_last_evaluation(run)
    without = Run.of(**QUICK, overrides=SMALL)
    train(without, tmp_path / "without")
    ours, theirs = (load_run(each) for each in (run, tmp_path / "without"))
    assert ours.statistics is not None
    assert theirs.statistics is None
    assert ours.statistics.count == pytest.approx(1 + SAC_RUN.steps, abs=1e-3)
    name = "actor.mu.weight"
    assert not ours.policy.state_dict()[name].equal(theirs.policy.state_dict()[name])


def test_gradient_steps_and_evaluations_use_the_statistics_without_changing_them():
    agent = agent_of("sac", {**SMALL, "normalize": True})
    assert agent._vec_normalize_env is agent.env
    agent.learn(20)
    before = statistics_of(agent)
    stored = agent.replay_buffer.observations[:20]
    batch = agent.replay_buffer._get_samples(np.arange(20), env=agent._vec_normalize_env)
    np.testing.assert_array_equal(batch.observations.numpy(), before(stored[:, 0]))
    evaluate(agent, Environments(TASK, 2), find("full", TASK), 2)
    after = statistics_of(agent)
    assert (before.count, *before.mean) == (after.count, *after.mean)


def test_a_run_that_begins_with_another_takes_its_statistics_along(run, tmp_path):
    later = SAC_RUN.replace(seed=1, steps=5, begin_from=str(run))
    train(later, tmp_path / "later")
    began = untrained(tmp_path / "later").statistics
    np.testing.assert_array_equal(began.mean, load_run(run).statistics.mean)
    assert load_run(tmp_path / "later").statistics.count == began.count + 6
    start = [r.episode_return for r in read_evaluations(tmp_path / "later") if r.step == 0]
    end = [r.episode_return for r in read_evaluations(run) if r.step == SAC_RUN.steps]
    assert start == pytest.approx(end, rel=1e-3)  # the first observation counts already
    for settings, message in (
        (SMALL, r"normalize true \(now: false\)"),
        ({**SMALL, "normalize": True, "activation_fn": "tanh"}, r"activation_fn relu \(now: tanh"),
        ({**SMALL, "normalize": True, "n_critics": 3}, r"n_critics none \(now: 3"),
    ):
        other = Run.of(**QUICK, overrides=settings, begin_from=str(run))
        with pytest.raises(InputError, match=message):
            train(other, tmp_path / "other")


STUDY = """
tasks = ["Pendulum-v1"]
representations = ["full"]
seeds = 1
steps = 40
episode_steps = 20
evaluation_episodes = 1

[algorithms.a2c-modern]

[algorithms.my-a2c]
base = "a2c-modern"
net_arch = [8]
normalize = true

[algorithms.tuned]
base = "a2c"
preset = "{preset}"
gamma = 0.9
"""


def test_a_study_of_learners(tmp_path):
    (tmp_path / "mine.toml").write_text(preset("a2c", {"net_arch": [4]}))
    path, out = tmp_path / "study.toml", tmp_path / "out"
    path.write_text(STUDY.format(preset=tmp_path / "mine.toml"))
    plan = Plan(read_study(path), out)
    plan.write()
    own = {
        "my-a2c": {"base": "a2c-modern", "net_arch": [8], "normalize": True},
        "tuned": {"base": "a2c-modern", "net_arch": [4], "gamma": 0.9},
    }
    written = json.loads((out / "study.json").read_text())
    assert (written["algorithms"], written["learners"]) == (["a2c-modern", *own], own)
    assert read_plan(out).study == read_study(path)
    tuned = plan.run(plan.cells[-1]).learner
    assert (tuned.preset, tuned.overrides) == ("modern", {"net_arch": [4], "gamma": 0.9})
    assert as_study(tomllib.loads(read_plan(out).study.toml())) == read_study(path)
    (tmp_path / "mine.toml").write_text(preset("a2c", {"net_arch": [5]}))
    with pytest.raises(InputError, match=r"holds another study: algorithms\.tuned"):
        Plan(read_study(path), out).write()
