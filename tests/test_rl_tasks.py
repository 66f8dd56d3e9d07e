"""Runs on tasks of any kind: sizes, terminations, failures, resuming by replay, version 1."""

import re

import cart
import numpy as np
import pytest
from behaviour import untrained
from command import jbrep
from small import ONE_EACH, assert_same_files, stopping

from jbrep.encoders import find
from jbrep.envs import Environments, describe
from jbrep.envs.autoreset import AutoresetEnvironments
from jbrep.envs.environments import EnvironmentFailedError
from jbrep.errors import InputError
from jbrep.play.sources import find_player
from jbrep.records import container
from jbrep.rl import Run, Session, StoppedError, train
from jbrep.rl.agent import evaluate, make_agent, make_env, training_seed
from jbrep.rl.controller import load_policy
from jbrep.rl.files import CHECKPOINT, EPISODES, EVALUATIONS, POLICY, read_evaluations, read_run
from jbrep.rl.policy import load_run
from jbrep.rl.presets import ALGORITHMS, get_preset

CART = describe(cart.ID)
HOPPER = describe("Hopper-v5")
SHORTER = {"n_steps": 16, "train_freq": 16, "gradient_steps": 4}
SMALL = {"net_arch": [8], "learning_starts": 50, "batch_size": 16}


def shorter(algorithm):
    """Shorter rollouts and fewer updates, where the algorithm has such settings."""
    known = ALGORITHMS[algorithm].presets["paper"].algorithm_kwargs
    return {name: n for name, n in (SMALL | SHORTER).items() if name in {*known, "net_arch"}}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_changes_its_weights(algorithm, tmp_path):
    how = {"preset": "paper", "overrides": shorter(algorithm), **ONE_EACH}
    result = train(Run.of(HOPPER, algorithm, steps=150, **how), tmp_path)
    assert result.status == "finished", result.reason
    playing = load_run(tmp_path)
    action = playing.begin(HOPPER, [0])(np.zeros((1, HOPPER.size)))
    assert action.shape == (1, HOPPER.action_size)
    before, after = untrained(tmp_path).policy.state_dict(), playing.policy.state_dict()
    assert any(not before[name].equal(after[name]) for name in before)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_the_units_of_actions_do_not_matter(algorithm, tmp_path):
    """Pulses of 1,000 to 2,000 us would be clipped nearly always, were they not scaled."""
    played, how = [], {"overrides": shorter(algorithm), "steps": 160}
    for name in (cart.ID, cart.SERVO):
        run = Run.of(name, algorithm, evaluation_episodes=2, final_episodes=2, **how)
        assert train(run, tmp_path / str(len(played))).status == "finished"
        rows = read_evaluations(tmp_path / str(len(played)))
        played.append([row.episode_return for row in rows])
    np.testing.assert_allclose(*played, rtol=0.01)
    (rollout,) = find_player(str(tmp_path / "1")).play([0])
    assert 1000 <= rollout.action.min() < rollout.action.max() <= 2000
    controller = load_policy(tmp_path / "1")
    exported = [controller(observation) for observation in rollout.observation[:-1]]
    np.testing.assert_allclose(exported, rollout.action, rtol=1e-5)


def test_evaluations_are_in_the_order_of_their_starts():
    """Episodes of different lengths end in another order."""
    encoder = find("full", HOPPER)
    chosen = get_preset("modern", "sac")
    agent = make_agent("sac", chosen, make_env(HOPPER, chosen, 0, encoder), 0)
    together, alone = (evaluate(agent, Environments(HOPPER, n), encoder, 4).returns for n in (4, 1))
    assert len(set(together.round(3))) == 4
    np.testing.assert_allclose(together, alone, rtol=1e-4)


def test_a_run_stopped_within_an_episode_resumes_to_the_same_bits(tmp_path):
    run = Run.of(HOPPER, "sac", preset="modern", overrides=SMALL, steps=320, **ONE_EACH)
    one, other = tmp_path / "one", tmp_path / "other"
    train(run, one)
    with pytest.raises(StoppedError):
        train(run, other, stopping(64))
    assert len(container.read(other / CHECKPOINT, "checkpoint")[0]["envs.actions"])
    train(run, other)
    assert_same_files(one, other, EPISODES, EVALUATIONS, POLICY)


def test_an_environment_that_fails_makes_the_run_fail(tmp_path):
    failing = CART.replace(arguments={"fail_seed": training_seed(0) + 3})
    run = Run.of(task=failing, algorithm="a2c", steps=800, preset="paper", **ONE_EACH)
    result = train(run, tmp_path)
    assert result.status == "failed"
    assert f"at step 7 of the episode with seed {training_seed(0) + 3}" in result.reason
    assert result.reason.startswith("after 48 steps: ")  # of 8 environments
    assert read_run(tmp_path) == result
    assert [row.step for row in read_evaluations(tmp_path)] == [0]
    assert not (tmp_path / POLICY).exists()
    with pytest.raises(InputError, match="failed: it has no policy"):
        load_run(tmp_path)


def broken(*_):
    raise EnvironmentFailedError("out of order")


def test_a_failure_while_resuming_leaves_the_checkpoint(tmp_path, monkeypatch):
    run = Run.of(task=CART, algorithm="a2c", steps=320, preset="paper", **ONE_EACH)
    with pytest.raises(StoppedError):
        train(run, tmp_path, Session(stop=iter((False, True)).__next__))
    before = (tmp_path / CHECKPOINT).read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(AutoresetEnvironments, "restore", broken)
        with pytest.raises(InputError, match="can't be resumed: out of order"):
            train(run, tmp_path)
    assert (tmp_path / CHECKPOINT).read_bytes() == before
    assert not (tmp_path / "run.json").exists()


def test_what_was_learned_outlives_an_environment_that_fails(tmp_path, monkeypatch):
    run = Run.of(CART, "sac", steps=160, preset="modern", overrides=SMALL, **ONE_EACH)
    session = Session(save_every=0, keep_checkpoint=True)
    whole = train(run, tmp_path / "whole", session)
    count, step = iter(range(1 << 20)), Environments.step

    def failing(envs, actions):
        if next(count) == 60:
            raise EnvironmentFailedError("the cable is loose")
        return step(envs, actions)

    with monkeypatch.context() as patch:
        patch.setattr(Environments, "step", failing)
        with pytest.raises(InputError, match=r"is loose; .* goes on from it"):
            train(run, tmp_path / "run", session)
    assert not (tmp_path / "run" / "run.json").exists()
    assert load_run(tmp_path / "run").step > 0
    assert train(run, tmp_path / "run", session).policy_sha256 == whole.policy_sha256


def test_an_environment_that_is_not_reproducible(tmp_path):
    """A run that was stopped isn't resumed to something else."""
    drifting = describe(cart.ID, {"drifts": True})
    run = Run.of(task=drifting, algorithm="a2c", steps=80, preset="paper", **ONE_EACH)
    with pytest.raises(StoppedError):
        train(run, tmp_path / "stopped", Session(stop=iter((False, True)).__next__))
    with pytest.raises(InputError, match="is not reproducible"):
        train(run, tmp_path / "stopped")
    assert (tmp_path / "stopped" / CHECKPOINT).exists()


@pytest.mark.parametrize(
    ("algorithm", "overrides"),
    [
        ("tqc", SMALL),
        ("a2c", {"num_envs": 1}),  # one robot, whose episodes last 40 steps
    ],
)
def test_a_run_goes_on_as_one_that_had_more_steps_at_first(algorithm, overrides, tmp_path):
    settings = {"algorithm": algorithm, "preset": "modern", "overrides": overrides}
    settings["one_robot"] = "num_envs" in overrides
    settings |= {"evaluate_every": 80, "evaluation_episodes": 2, "final_episodes": 3}
    shorter, longer = (Run.of(CART, steps=steps, **settings) for steps in (160, 320))
    grown, whole = tmp_path / "grown", tmp_path / "whole"
    train(shorter, grown, Session(keep_checkpoint=True))
    train(shorter, tmp_path / "short")
    assert_same_files(grown, tmp_path / "short", EVALUATIONS)
    train(longer, grown)
    train(longer, whole)
    assert_same_files(grown, whole, EPISODES, EVALUATIONS, POLICY, "policy.zip")
    with pytest.raises(InputError, match=r"can't go on: checkpoint.safetensors is missing"):
        train(Run.of(CART, steps=400, **settings), grown)
    with pytest.raises(InputError, match=r"holds another run: steps 320 \(now: 160\)"):
        train(shorter, grown)


def test_a_run_that_fails_as_it_goes_on_keeps_what_it_had(tmp_path, monkeypatch):
    settings = ("rl", "--task", cart.ID, "--algorithm", "sac", "--preset", "modern")
    settings += ("--set", "net_arch=[8]", "--set", "batch_size=16", "--evaluate-every", 80)
    settings += ("--evaluation-episodes", 2, "--final-episodes", 3, "--out")
    folder, whole = tmp_path / "grown", tmp_path / "whole"
    assert jbrep(*settings, folder, "--steps", 160).exit_code == 0
    kept = (CHECKPOINT, EPISODES, EVALUATIONS, POLICY, "policy.zip", "run.json")
    before = {name: (folder / name).read_bytes() for name in kept}
    count, step = iter(range(1 << 20)), Environments.step

    def failing(envs, actions):
        return broken() if next(count) == 60 else step(envs, actions)

    with monkeypatch.context() as patch:
        patch.setattr(Environments, "step", failing)  # once the episode of now was played again
        told = jbrep(*settings, folder, "--steps", 320)
    assert told.exit_code == 1
    assert re.search("the run failed: after [0-9]+ steps: out of order", told.stderr)
    assert {name: (folder / name).read_bytes() for name in kept} == before
    assert load_run(folder).settings.steps == 160
    for each in (folder, whole):
        assert jbrep(*settings, each, "--steps", 320).exit_code == 0
    assert_same_files(folder, whole, EPISODES, EVALUATIONS, POLICY)


def test_one_robot_remembers_what_it_saw_before_an_evaluation(tmp_path):
    """An evaluation begins the next episode once more; no transition is made of two."""
    overrides = {"num_envs": 1, "learning_starts": 1000, "normalize": True}
    how = {"algorithm": "sac", "preset": "modern", "overrides": overrides}
    run = Run.of(CART, steps=100, evaluate_every=25, **how, **ONE_EACH)
    train(run.replace(one_robot=True), tmp_path, Session(keep_checkpoint=True))
    assert len({row.step for row in read_evaluations(tmp_path)}) == 5
    tensors, _ = container.read(tmp_path / CHECKPOINT, "checkpoint")
    before, after, dones = (
        tensors[f"buffer.{name}"][:, 0] for name in ("observations", "next_observations", "dones")
    )
    goes_on = (dones[:-1] == 0) & (tensors["buffer.timeouts"][:-1, 0] == 0)
    assert 80 < goes_on.sum() < 99
    np.testing.assert_array_equal(before[1:][goes_on], after[:-1][goes_on])
