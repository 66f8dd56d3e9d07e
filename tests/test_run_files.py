"""A run's folder read back: damaged, forged, under way; whatever comes, one line or a policy."""

import functools
import hashlib
import json
import operator
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from behaviour import untrained
from command import jbrep, mistake, refused
from small import ONE_EACH, forge
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jbrep.encoders import find, save
from jbrep.envs import describe
from jbrep.play.sources import find_player
from jbrep.records import container
from jbrep.records.record import to_plain
from jbrep.rl import Run, Session, train
from jbrep.rl.files import CHECKPOINT, ENCODER, EVALUATIONS, POLICY, read_evaluations, read_run
from jbrep.rl.history import Scalars
from jbrep.rl.policy import load_run

TASK = describe("face_direction", episode_steps=100)
SETTINGS = Run.of(task=TASK, algorithm="a2c", encoder="dae-8", steps=80, preset="paper", **ONE_EACH)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run, and beside it the checkpoint that it had after 40 steps."""
    folder = tmp_path_factory.mktemp("runs") / "a2c"
    write = container.write

    def keep(path, tensors, header):
        write(path, tensors, header)
        if path.name == CHECKPOINT and header["step"] == 40:
            shutil.copy(path, folder.parent)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(container, "write", keep)
        train(SETTINGS, folder, Session(save_every=0))
    return folder


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the run to spoil."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture
def under_way(trained, tmp_path):
    """The same run as it was when its checkpoint was written."""
    folder = tmp_path / "under-way"
    folder.mkdir()
    shutil.copy(trained / ENCODER, folder)
    shutil.copy(trained.with_name(CHECKPOINT), folder)
    return folder


def change(folder, **changes):
    record = json.loads((folder / "run.json").read_text())
    forge(folder / "run.json", {**record, **changes})


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("status",), "x"),
        (("settings", "environment", "id"), "../../up"),
        (("settings", "hyperparameters", "num_envs"), 10**30),
    ],
    ids=str,
)
def test_a_field_of_a_run_that_cant_be_is_named(path, value, run):
    record = json.loads((run / "run.json").read_text())
    *parents, name = path
    functools.reduce(operator.getitem, parents, record)[name] = value
    forge(run / "run.json", record)
    told = refused(read_run, run)
    assert ("run.json" in told, name in told) == (True, True)


def test_weights_are_those_of_the_run(run):
    path = run / POLICY
    weights, header = container.read(path, "policy")
    container.write(path, weights | {"more": np.ones(1)}, header)
    assert "its SHA-256 isn't in run.json" in refused(load_run, run)
    change(run, policy_sha256=None)
    assert "no policy" in refused(load_run, run)


def test_evaluations_are_those_of_the_run(run):
    with (run / EVALUATIONS).open("a") as file:
        file.write("90,0,1\n")
    assert EVALUATIONS in refused(read_evaluations, run)
    mistake("report", run)


def without(tensors, name):
    return {key: value for key, value in tensors.items() if key != name}


@pytest.mark.parametrize(
    "make",
    [
        lambda tensors: without(tensors, "policy.action_net.bias"),
        lambda tensors: {**tensors, "policy.more": np.ones(1, np.float32)},
        lambda tensors: {**tensors, "policy.log_std": np.ones(3, np.float32)},
        lambda tensors: {**tensors, "policy.log_std": np.full(1, np.nan, np.float32)},
    ],
    ids=range(4),
)
def test_a_policy_that_isn_t_the_run_s(make, run):
    """Its hashes are right: a stranger can work them out."""
    path = run / POLICY
    tensors, header = container.read(path, "policy")
    container.write(path, make(tensors), header)
    change(run, policy_sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    assert POLICY in refused(load_run, run)


def test_a_run_under_way_plays_its_checkpoint(under_way, trained):
    playing = load_run(under_way)
    assert playing.step == 40
    final, first, now = (
        each.policy.state_dict()["action_net.weight"]
        for each in (load_run(trained), untrained(under_way), playing)
    )
    assert not now.equal(final)
    assert not now.equal(first)
    assert find_player(str(under_way)).step == 40


def test_a_damaged_checkpoint_is_named(under_way):
    path = under_way / CHECKPOINT
    tensors, header = container.read(path, "checkpoint")
    seed = {"settings": {**header["settings"], "seed": 10**30}}
    for changes in ({"settings": "x"}, {"episodes": "x"}, seed, {"step": -1}):
        container.write(path, tensors, {**header, **changes})
        assert CHECKPOINT in refused(load_run, under_way)
    container.write(path, without(tensors, "parameters.policy.log_std"), header)
    assert "doesn't fit the run's settings" in refused(load_run, under_way)
    path.write_bytes(path.read_bytes()[:100])
    assert CHECKPOINT in refused(load_run, under_way)
    assert CHECKPOINT in refused(train, SETTINGS, under_way)


def test_evaluating_a_run(run):
    by_folder = jbrep("evaluate-policy", run, "--episodes", 2).output
    for name in (POLICY, "policy.zip"):
        assert jbrep("evaluate-policy", run / name, "--episodes", 2).output == by_folder
    record = json.loads(jbrep("evaluate-policy", run, "--episodes", 2, "--json").output)
    assert (record["task"], record["representation"]) == (TASK.name, "dae-8")
    assert record["median"] == pytest.approx(np.median(record["returns"]))
    assert len(record["returns"]) == 2


def test_another_encoder_is_not_the_run_s(run):
    save(find("pca-8", TASK), run / ENCODER)
    assert "is not the encoder that the run in" in refused(load_run, run)
    settings = json.loads((run / "run.json").read_text())["settings"]
    own = find("pca-8", TASK).fingerprint
    pose = {"task": "move_to_pose", "environment": to_plain(describe("move_to_pose"))}
    change(run, settings={**settings, "encoder": own, **pose})
    assert "was made for face_direction" in refused(load_run, run)


def test_tensorboard_keeps_what_was_logged_at_the_step_of_a_checkpoint(tmp_path):
    for step in (0, 20):  # before it was stopped, and after
        scalars = Scalars(tmp_path, step)
        scalars.write({"evaluation": 1.0}, {"evaluation": ()}, step + 20)
        scalars.write({"evaluation": 2.0}, {"evaluation": ()}, step + 30)
        scalars.close()
        time.sleep(1.1)  # files are read in the order of their names, which have the second in them
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [e.step for e in events.Scalars("evaluation")] == [20, 40, 50]
