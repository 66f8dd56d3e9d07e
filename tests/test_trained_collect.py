"""Collecting with the policies of runs: kept with the data, acting alike in whatever order."""

import pickle
import shutil

import numpy as np
import pytest
from command import jbrep
from small import ONE_EACH, contents, settings

from jbrep.collecting import collect
from jbrep.collecting.backends import make_episodes
from jbrep.collecting.shards import Simulator
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import find_problems
from jbrep.dataset.schema import joined
from jbrep.envs import describe
from jbrep.envs.names import Known, import_modules
from jbrep.inspection.subject import _find
from jbrep.play.sources import find_player, find_policy
from jbrep.records import container
from jbrep.rl import Run, Session, train
from jbrep.rl.files import CHECKPOINT
from jbrep.rl.policy import load_run, pack

import_modules(["environments"])
SHORT = describe("face_direction", episode_steps=40)
SLEDGE = describe("Sledges/Sledge-v0")
POLICY = "policy-0.safetensors"
NORMALIZE = {"normalize": True}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Finished runs; beside one its checkpoint of an earlier step, as a run under way."""
    folder, write = tmp_path_factory.mktemp("runs"), container.write
    under_way = folder / "under_way"
    under_way.mkdir()

    def keep(path, tensors, header):
        write(path, tensors, header)
        if path.name == CHECKPOINT and header["counters"]["num_timesteps"] == 40:
            for each in path.parent.glob("*.safetensors"):
                shutil.copy(each, under_way)

    usual = {"preset": "paper", "evaluate_every": 80, **ONE_EACH}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(container, "write", keep)
        run = Run.of(task=SHORT, algorithm="a2c", encoder="dae-8", steps=80, **usual)
        train(run, folder / "jb", Session(save_every=0))
    train(Run.of(SLEDGE, "sac", steps=20, overrides=NORMALIZE, **usual), folder / "sledge")
    return folder


def some(policy, folder, **changes):
    """Settings and policy of what a command would collect."""
    usual = {"task": SHORT, "steps": 240, "shard_episodes": 4, "store_state": True, **changes}
    actor = find_policy(str(policy), folder, usual["task"])
    return settings(policy=actor.settings(), **usual), actor


def gather(policy, folder, how=None, **changes):
    chosen, actor = some(policy, folder, **changes)
    collect(chosen, folder, policy=actor, **(how or {}))
    return folder


@pytest.fixture(scope="module")
def data(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "data"
    return gather(f"uniform:0.5+{runs / 'jb'}:0.5", folder)


def test_the_policy_acts_as_it_does_for_the_run(runs, tmp_path):
    dataset = Dataset(gather(runs / "jb", tmp_path / "data"))
    trained = load_run(runs / "jb")
    expected = trained.begin(SHORT, [0])(dataset["observation"][:])
    np.testing.assert_allclose(dataset["action"][:], expected, atol=1e-5)
    about = dataset.manifest.settings.policy
    assert (about["kind"], about["run"], about["step"]) == ("trained", str(runs / "jb")[-200:], 80)
    assert f"trained, run {about['run']}, step 80" in " ".join(
        jbrep("data", "info", tmp_path / "data").output.split()
    ).replace("- ", "-")


def test_neither_environments_nor_threads_nor_extension_change_a_byte(data, runs, tmp_path):
    text = f"uniform:0.5+{runs / 'jb'}:0.5"
    for steps, how in ((100, {"num_envs": 3}), (240, {"num_envs": 1, "num_threads": 1})):
        gather(text, tmp_path / "data", how, steps=steps)
    assert contents(tmp_path / "data") == contents(data)
    assert set(Dataset(data).episodes["policy"].tolist()) == {0, 1}


def test_a_worker_makes_the_same_episodes(runs, tmp_path):
    """Of a network that gives actions in [-1, 1] for what has been normalised before."""
    chosen, actor = some(runs / "sledge", tmp_path, task=SLEDGE, store_state=False, steps=80)
    gather(runs / "sledge", tmp_path / "data", {"num_threads": 1}, task=SLEDGE, store_state=False)
    known = Known.of([SLEDGE])
    each = chosen.shard_episodes
    second = range(each, 2 * each)
    sent = pickle.loads(pickle.dumps((known, Simulator(chosen, actor, 1, 1), second)))
    made, dataset = joined(make_episodes(*sent)), Dataset(tmp_path / "data")
    start = dataset.manifest.shards[0].rows
    rows = slice(start, start + len(made["action"]))
    np.testing.assert_array_equal(made["action"], dataset["action"][rows])
    expected = load_run(runs / "sledge").begin(SLEDGE, [0])(dataset["observation"][:])
    np.testing.assert_allclose(dataset["action"][:], expected, atol=1e-4)


def test_a_data_set_keeps_the_policy_of_a_run_that_goes_on_or_is_gone(runs, tmp_path):
    run, out = tmp_path / "run", tmp_path / "data"
    shutil.copytree(runs / "under_way", run)
    command = ("collect", "--task", "face_direction", "--episode-steps", 40, "--policy", run)
    command += ("--shard-episodes", 4, "--out", out)
    assert jbrep(*command, "--steps", 80).exit_code == 0
    kept = (out / POLICY).read_bytes()
    (run / CHECKPOINT).unlink()
    shutil.copytree(runs / "jb", run, dirs_exist_ok=True)
    for gone in (False, True):
        if gone:
            shutil.rmtree(run)
        told = jbrep(*command, "--steps", 200)
        assert told.exit_code == 0, told.output
        assert f"{out / POLICY} keeps the policy of" in told.stderr
        assert "at step 40" in told.stderr
    assert (out / POLICY).read_bytes() == kept
    gather(runs / "under_way", tmp_path / "once", steps=200, seed=0, store_state=False)
    for name, column in Dataset(out).episodes.items():
        np.testing.assert_array_equal(column, Dataset(tmp_path / "once").episodes[name])


def test_it_is_verified(data, tmp_path):
    folder = shutil.copytree(data, tmp_path / "data")
    told = jbrep("data", "verify", folder, "--replay", 3)
    assert told.exit_code == 0, told.output
    (folder / POLICY).write_bytes(b"another")
    (problem,) = find_problems(folder)
    assert "policy-0.safetensors is damaged or missing: it is the policy of" in problem


def test_a_policy_s_file_works_wherever_a_policy_is_named(runs, tmp_path):
    path = tmp_path / "mine.safetensors"
    path.write_bytes(pack(load_run(runs / "jb"), "mine"))
    player, of_run = find_player(str(path)), find_player(str(runs / "jb"))
    np.testing.assert_array_equal(player.returns(2), of_run.returns(2))
    assert player.representation == "dae-8"
    told = [jbrep("evaluate-policy", each, "--episodes", 2) for each in (path, runs / "jb")]
    assert told[0].output == told[1].output
    dataset = Dataset(gather(path, tmp_path / "data"))
    assert dataset.manifest.settings.policy["run"] == "mine"
    rollout, encoder = _find(str(path), 1, None, None)
    assert (rollout.name, encoder.name) == (str(path), "dae-8")
