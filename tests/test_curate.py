"""Replaying and deriving data sets."""

import numpy as np
import pytest
import small
from small import contents, settings, written

from jbrep.collecting import collect
from jbrep.collecting.derive import derive
from jbrep.collecting.replay import replay_problems
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import commit, open_shard, read_manifest, write_manifest
from jbrep.errors import InputError
from jbrep.jitterbug import bodies, simulation
from jbrep.jitterbug.tasks import TASKS


def test_replayed_episodes_are_equal_bit_for_bit(collected):
    dataset = Dataset(collected)
    assert not list(replay_problems(dataset, 5, num_threads=1))
    assert not list(replay_problems(dataset, 0))
    with pytest.raises(InputError, match="6 episodes can't be replayed: the data set has 5"):
        list(replay_problems(dataset, 6))


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("observation", 40),
        ("action", 10),
        ("reward", 99),
        ("qvel", 50),
        ("episodes/target_position", 0),
        ("episodes/final_observation", 0),
    ],
)
def test_replay_finds_one_bit_of_difference(name, row, brief, tmp_path):
    """As another machine's rounding would make it: all hashes hold."""
    manifest = read_manifest(brief)
    spoiled = manifest.replace(shards=())
    for shard in range(2):
        columns = dict(open_shard(brief, manifest, shard))
        if shard == 1:
            values = columns[name].copy()
            values.reshape(len(values), -1)[row].view(np.uint8)[0] ^= 1
            columns[name] = values
        spoiled = commit(tmp_path, spoiled, columns)
    (problem,) = replay_problems(Dataset(tmp_path), 2)
    assert "episode 1 simulated again differs" in problem


@pytest.mark.parametrize("task", TASKS)
def test_a_derived_data_set_is_the_collected_one(task, brief, tmp_path):
    """All files, to the last bit, as if it had been collected."""
    wanted = small.brief(task=task, store_state=task == "move_to_pose")
    collect(wanted, tmp_path / "collected")
    assert derive(brief, task, tmp_path / "derived", wanted.store_state).rows == 500
    assert contents(tmp_path / "derived") == contents(tmp_path / "collected")


def test_a_derivation_goes_on_and_leaves_a_finished_one_alone(collected, tmp_path):
    derive(collected, "move_to_pose", tmp_path / "whole")
    manifest = read_manifest(tmp_path / "whole")
    folder = tmp_path / "begun"
    begun = manifest.replace(shards=())
    folder.mkdir()
    for shard in range(2):
        begun = commit(folder, begun, open_shard(tmp_path / "whole", manifest, shard))
    assert written(folder, lambda: derive(collected, "move_to_pose", folder)) == [2, 3, 4]
    assert contents(folder) == contents(tmp_path / "whole")
    assert written(folder, lambda: derive(collected, "move_to_pose", folder)) == []


def test_what_can_t_be_derived(collected, copied, tmp_path):
    with pytest.raises(InputError, match="other settings: task face_direction"):
        derive(collected, "move_to_pose", copied)
    derive(collected, "face_direction", tmp_path / "stateless")
    with pytest.raises(InputError, match="has no states: collect it with --store-state"):
        derive(tmp_path / "stateless", "move_to_pose", tmp_path / "x")
    collect(settings(steps=1000, policy={"kind": "heuristic"}), tmp_path / "heuristic")
    with pytest.raises(InputError, match="heuristic"):
        derive(tmp_path / "heuristic", "move_to_pose", tmp_path / "x")
    manifest = read_manifest(copied)
    (copied / "shard-00004.h5").unlink()
    write_manifest(copied, manifest.replace(shards=manifest.shards[:4]))
    with pytest.raises(InputError, match="is unfinished"):
        derive(copied, "move_to_pose", tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_other_versions_are_not_passed_off_as_these(copied, tmp_path):
    manifest = read_manifest(copied)
    older = {**manifest.versions, "mujoco": "3.16.9"}
    write_manifest(copied, manifest.replace(versions=older))
    with pytest.raises(InputError, match="a derived data set needs the same"):
        derive(copied, "move_to_pose", tmp_path / "derived")
    assert not (tmp_path / "derived").exists()


def test_states_of_an_earlier_jbrep_are_derived_from_if_the_robot_is_the_same(
    copied, tmp_path, monkeypatch
):
    manifest = read_manifest(copied)
    write_manifest(copied, manifest.replace(versions={**manifest.versions, "jbrep": "0.0.9"}))
    heavier = bodies.read_xml().replace('density="7700"', 'density="7701"')
    with monkeypatch.context() as changed:
        changed.setattr(bodies, "read_xml", lambda: heavier)
        changed.setattr(
            simulation, "fast_model", simulation.fast_model.__wrapped__
        )  # without its cache
        with pytest.raises(InputError, match="needs the same states"):
            derive(copied, "move_to_pose", tmp_path / "derived")
    assert not (tmp_path / "derived").exists()
    assert derive(copied, "move_to_pose", tmp_path / "derived").rows == manifest.settings.steps
