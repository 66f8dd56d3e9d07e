"""Reading: columns over shards, splits, scaling, batches, and tools that know nothing of jbrep."""

import json
import os
import shutil
from itertools import accumulate
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import jbrep
from small import brief, contents, write_again, written

from jbrep.collecting import collect
from jbrep.collecting.derive import derive
from jbrep.collecting.replay import replay_problems
from jbrep.dataset import Dataset, manifest
from jbrep.dataset.columns import Column
from jbrep.dataset.manifest import MANIFEST, commit, find_problems, open_shard, read_manifest
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS


@pytest.fixture(scope="module")
def dataset(collected):
    return Dataset(collected)


@pytest.fixture(scope="module")
def parts():
    random = np.random.default_rng(0)
    return [random.normal(size=(rows, 3)) for rows in (4, 0, 7, 1)]


@pytest.fixture(scope="module")
def column(parts):
    ends = list(accumulate(len(part) for part in parts))
    return Column(lambda shard: parts[shard], ends, np.dtype(float), (3,))


@pytest.mark.parametrize(
    "key",
    [
        *(0, -1, slice(None), slice(2, 9), slice(4, 4), slice(-3, None), slice(11, 2, -2)),
        *(np.array([0, 11, 4, 4, -2]), np.array([], dtype=int), np.array([[1, 5], [11, 0]])),
        *(np.arange(12) % 3 == 0, np.zeros(12, dtype=bool)),
        *((5, 1), (slice(3, 8), 2), (slice(None), slice(1, None)), (np.array([7, 0]), 0)),
    ],
    ids=str,
)
def test_a_column_is_indexed_like_the_array_it_stands_for(column, parts, key):
    expected = np.concatenate(parts)[key]
    np.testing.assert_array_equal(column[key], expected)
    assert column[key].shape == expected.shape
    assert column[key].dtype == expected.dtype


def test_a_column_as_an_array(column, parts):
    whole = np.concatenate(parts)
    assert column.shape == whole.shape
    assert len(column) == 12
    np.testing.assert_array_equal(np.asarray(column), whole)
    np.testing.assert_array_equal(np.stack(list(column)), whole)
    np.testing.assert_array_equal(np.concatenate(list(column.chunks(3))), whole)
    assert np.asarray(column, dtype=np.float32).dtype == np.float32
    np.testing.assert_array_equal(column[[2, 1]], whole[[2, 1]])
    for dtype in (np.uint8, np.int8, np.int64):
        np.testing.assert_array_equal(column[np.array([2, 1], dtype)], whole[[2, 1]])
    assert column[()].shape == whole[()].shape == (12, 3)


@pytest.mark.parametrize("key", [12, -13, [3, 12], "motor", ([0, 1], [0, 1]), np.ones(5, bool)])
def test_what_is_no_index_of_a_column(key, column):
    with pytest.raises(IndexError):
        column[key]


def test_a_slice_within_a_shard_is_a_view_of_the_file(dataset):
    rows = dataset["observation"][1100:1200]
    assert not rows.flags.owndata
    assert not rows.flags.writeable
    assert dataset["observation"][900:1100].flags.owndata


def test_features_and_observables_by_name(dataset):
    observation = dataset["observation"][:]
    names = TASKS["face_direction"].plain.feature_names
    for i, name in enumerate(names):
        np.testing.assert_array_equal(dataset[name][:], observation[:, i])
    np.testing.assert_array_equal(dataset["velocity"][10:20], observation[10:20, 7:10])
    assert dataset["velocity"].shape == (5000, 3)
    assert dataset["motor_velocity"][[3, 4999]].shape == (2,)
    with pytest.raises(InputError, match="no column, group or feature 'speed': choose one of"):
        dataset["speed"]


def test_an_array_of_a_column_is_the_reader_s_own(dataset, collected, tmp_path):
    collect(brief(steps=100), tmp_path / "one")
    for data in (dataset, Dataset(tmp_path / "one")):
        values = np.array(data["reward"])
        assert values.flags.writeable
        assert isinstance(data["reward"][5], np.float32)


def test_episodes_have_columns_of_their_own(dataset):
    episodes = dataset.episodes
    np.testing.assert_array_equal(episodes["episode"], np.arange(5))
    np.testing.assert_array_equal(episodes["length"], 1000)
    reward = dataset["reward"][:].reshape(5, 1000).astype(float)
    np.testing.assert_allclose(episodes["return"], reward.sum(axis=1), rtol=1e-12)
    np.testing.assert_array_equal(episodes["initial_qpos"], dataset["qpos"][::1000])
    assert not np.array_equal(episodes["final_qpos"], dataset["qpos"][999::1000])


def test_an_episode_is_its_rows_and_what_is_stored_once_for_it(dataset):
    episode = dataset.episode(3)
    assert (episode.number, episode.rows, len(episode)) == (3, slice(3000, 4000), 1000)
    for name in ("reward", "qpos", "velocity", "motor_angle"):
        np.testing.assert_array_equal(episode[name], dataset[name][3000:4000])
    assert episode.record["seed"] == 4 * 2**32 + 3
    np.testing.assert_array_equal(episode.record["initial_qpos"], dataset["qpos"][3000])
    for number in (5, -1):
        with pytest.raises(InputError, match=f"no episode {number}: it has 5, numbered from 0"):
            dataset.episode(number)


def test_the_split_is_by_episode_and_seeded(dataset):
    train, test = dataset.split()
    episode = dataset["episode"][:]
    assert len(np.unique(episode[test])) == 1
    assert not set(episode[train]) & set(episode[test])
    np.testing.assert_array_equal(np.union1d(train, test), np.arange(5000))
    np.testing.assert_array_equal(test, dataset.split().test)
    assert len({tuple(np.unique(episode[dataset.split(seed=s).test])) for s in range(20)}) > 1
    assert len(np.unique(episode[dataset.split(test=0.99).test])) == 4
    with pytest.raises(InputError, match="between 0 and 1"):
        dataset.split(test=1)


def test_a_reader_sees_whole_shards_while_a_collector_writes(collected, tmp_path):
    seen, whole = [], Dataset(collected)

    def look(columns):
        dataset = Dataset(tmp_path / "growing")
        np.testing.assert_array_equal(dataset["observation"], whole["observation"][: len(dataset)])
        seen.append((len(dataset), dataset.manifest.complete))
        return columns

    write_again(collected, tmp_path / "growing", look)
    assert seen == [(1000 * k, False) for k in range(5)]
    assert Dataset(tmp_path / "growing").manifest.complete


def test_a_data_set_as_json(dataset):
    about = json.loads(jbrep("data", "info", dataset.folder, "--json").stdout)
    assert (about["task"], about["rows"], about["episodes"]) == ("face_direction", 5000, 5)
    assert about["return"]["mean"] == pytest.approx(dataset.episodes["return"].mean())
    shown, speed = about["features"][14], dataset["motor_velocity"][:].astype(float)
    assert (shown["feature"], shown["unit"]) == ("motor_velocity", "rad/s")
    assert shown["nominal"] == [-180, 180]
    of_all = [speed.min(), speed.mean(), speed.max(), speed.std()]
    assert [shown[n] for n in ("min", "mean", "max", "std")] == pytest.approx(of_all, rel=1e-3)
    assert "motor_velocity" in dataset.card()


def test_an_unfinished_data_set_is_called_so(collected, tmp_path):
    whole = manifest.read_manifest(collected)
    whole.replace(shards=()).write(tmp_path / MANIFEST)
    empty = Dataset(tmp_path)
    assert len(empty) == len(empty["observation"][:]) == 0
    assert "that were asked for" in empty.card()
    with pytest.raises(InputError, match="a split needs at least 2 episodes"):
        empty.split()


def test_a_shard_is_flat_columns_that_any_hdf5_tool_opens(collected):
    with h5py.File(collected / "shard-00002.h5") as file:
        assert file["observation"].shape == (1000, 16)
        assert all(file[name].chunks is None for name in file if name != "episodes")
        names = TASKS["face_direction"].plain.feature_names
        assert tuple(file.attrs["feature_names"]) == names
        assert list(file.attrs["feature_units"][-3:]) == ["rad", "rad/s", "rad"]
        about = [file.attrs[name] for name in ("task", "seed", "shard")]
        assert about == ["face_direction", 3, 2]
        assert file["episodes/seed"][:].tolist() == [4 * 2**32 + 2]


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
    manifest.replace(versions=older).write(copied / MANIFEST)
    with pytest.raises(InputError, match="a derived data set needs the same"):
        derive(copied, tmp_path / "x", HIDDEN)
    (copied / "shard-00004.h5").unlink()
    manifest.replace(shards=manifest.shards[:4]).write(copied / MANIFEST)
    with pytest.raises(InputError, match="is unfinished"):
        derive(copied, tmp_path / "x", HIDDEN)
    assert not (tmp_path / "x").exists()


def two_by_two(steps, **changes):
    return brief(steps=steps, shard_episodes=2, **changes)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A shard of two episodes and one of one."""
    folder = tmp_path_factory.mktemp("short") / "data"
    collect(two_by_two(300), folder)
    return folder


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Two shards of two episodes and one of one, collected at once."""
    folder = tmp_path_factory.mktemp("long") / "data"
    collect(two_by_two(500), folder)
    return folder


class Kill(BaseException):
    """As sudden as an exception can be."""


def test_a_kill_at_any_moment_leaves_what_is_read_and_extended(short, long, tmp_path, monkeypatch):
    """Four files are written, each in three stages; full shards are there all the time."""
    before, left = Dataset(short), 0

    def deadly(call):
        def wrapped(*arguments, **keywords):
            nonlocal left
            left -= 1
            if left < 0:
                raise Kill
            return call(*arguments, **keywords)

        return wrapped

    for stage in range(12):
        folder, left = shutil.copytree(short, tmp_path / str(stage)), stage
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", deadly(os.fsync))
            patch.setattr(Path, "replace", deadly(Path.replace))
            with pytest.raises(Kill):
                write_again(long, folder)
        assert not list(find_problems(folder)), stage
        seen = Dataset(folder)["observation"][:200]
        np.testing.assert_array_equal(seen, before["observation"][:200])
        write_again(long, folder)
        assert contents(folder) == contents(long)


def test_what_can_t_be_extended_is_left_as_it_is(short, tmp_path):
    folder = shutil.copytree(short, tmp_path / "data")
    with pytest.raises(InputError, match="300 steps"):
        collect(two_by_two(200), folder)
    with pytest.raises(InputError, match=r"other settings: steps 300 \(now: 400\), seed 3"):
        collect(two_by_two(400, seed=4), folder)
    manifest = read_manifest(folder)
    changed = manifest.replace(versions={**manifest.versions, "mujoco": "3.0"})
    changed.write(folder / MANIFEST)
    with pytest.raises(InputError, match=r"mujoco 3\.0"):
        collect(two_by_two(400), folder)
    assert read_manifest(folder) == changed
    now, before = contents(folder), contents(short)
    assert [name for name in now if now[name] != before[name]] == [MANIFEST]
