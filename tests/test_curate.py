"""Replaying and deriving data sets."""

import numpy as np
import pytest
from small import contents, written

from jbrep.collecting.derive import derive
from jbrep.collecting.replay import replay_problems
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import commit, open_shard, read_manifest, write_manifest
from jbrep.errors import InputError


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


HIDDEN = ["*velocity*"]


def test_a_derivation_goes_on_and_leaves_a_finished_one_alone(collected, tmp_path):
    derive(collected, tmp_path / "whole", HIDDEN)
    manifest = read_manifest(tmp_path / "whole")
    folder = tmp_path / "begun"
    begun = manifest.replace(shards=())
    folder.mkdir()
    for shard in range(2):
        begun = commit(folder, begun, open_shard(tmp_path / "whole", manifest, shard))
    assert written(folder, lambda: derive(collected, folder, HIDDEN)) == [2, 3, 4]
    assert contents(folder) == contents(tmp_path / "whole")
    assert written(folder, lambda: derive(collected, folder, HIDDEN)) == []


def test_what_can_t_be_derived(collected, copied, tmp_path):
    with pytest.raises(InputError, match="other settings"):
        derive(collected, copied, HIDDEN)
    manifest = read_manifest(copied)
    older = {**manifest.versions, "mujoco": "3.16.9"}
    write_manifest(copied, manifest.replace(versions=older))
    with pytest.raises(InputError, match="a derived data set needs the same"):
        derive(copied, tmp_path / "x", HIDDEN)
    (copied / "shard-00004.h5").unlink()
    write_manifest(copied, manifest.replace(shards=manifest.shards[:4]))
    with pytest.raises(InputError, match="is unfinished"):
        derive(copied, tmp_path / "x", HIDDEN)
    assert not (tmp_path / "x").exists()
