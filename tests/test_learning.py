"""The thin pipeline below the command line: collect, split, encode, reload."""

import h5py
import numpy as np
import pytest
import torch

from jbrep.collect import Collection, collect
from jbrep.dae import Training, train
from jbrep.dataset import COLUMNS, Dataset
from jbrep.encoders import Encoder
from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import TASKS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "face_direction"
    collect(Collection("face_direction", 5000, seed=3), folder)
    return folder


@pytest.fixture(scope="module")
def dataset(folder):
    return Dataset(folder)


@pytest.fixture(scope="module")
def encoder(dataset):
    return train(dataset, Training(8, epochs=30, batch_size=100, learning_rate=5e-3))


def test_the_shard_is_flat_columns_that_any_hdf5_tool_opens(folder):
    with h5py.File(folder / "shard-00000.h5") as file:
        assert set(file) == set(COLUMNS)
        assert file["observation"].shape == (5000, 16)
        assert all(file[name].chunks is None for name in file)
        assert file.attrs["task"] == "face_direction"
        assert list(file.attrs["feature_names"]) == list(TASKS["face_direction"].feature_names)
    assert [path.name for path in folder.iterdir()] == ["shard-00000.h5"]


def test_rows_are_the_episodes_of_a_random_policy(dataset):
    columns = dataset.columns
    assert len(dataset) == 5000
    np.testing.assert_array_equal(columns["episode"], np.repeat(np.arange(5), 1000))
    np.testing.assert_array_equal(columns["step"], np.tile(np.arange(1000), 5))
    assert abs(columns["action"].mean()) < 0.05
    assert columns["action"].std() == pytest.approx(1 / np.sqrt(3), rel=0.02)


def test_stored_actions_replay_the_episode(dataset):
    """The episode's generator draws its start, as documented; the actions lead through its rows."""
    simulation = Simulation(dataset.task, 1, 1)
    sequence = np.random.SeedSequence(3, spawn_key=(2,))
    simulation.reset([0], [np.random.default_rng(sequence)])
    rows = dataset.columns["episode"] == 2
    for observation, action, reward in zip(
        *(dataset.columns[name][rows] for name in ("observation", "action", "reward")), strict=True
    ):
        np.testing.assert_array_equal(simulation.observe()[0].astype(np.float32), observation)
        simulation.step(action[None])
        assert simulation.reward()[0].astype(np.float32) == reward


def test_threads_do_not_change_the_data(dataset, tmp_path):
    collect(Collection("face_direction", 5000, seed=3), tmp_path / "again", num_threads=1)
    again = Dataset(tmp_path / "again")
    for name in COLUMNS:
        np.testing.assert_array_equal(dataset.columns[name], again.columns[name])


def test_the_split_is_by_episode_and_seeded(dataset):
    train_rows, test_rows = dataset.split()
    episode = dataset.columns["episode"]
    assert len(np.unique(episode[test_rows])) == 1
    assert not set(episode[train_rows]) & set(episode[test_rows])
    np.testing.assert_array_equal(np.union1d(train_rows, test_rows), np.arange(5000))
    np.testing.assert_array_equal(test_rows, dataset.split()[1])
    others = {tuple(np.unique(episode[dataset.split(seed=seed)[1]])) for seed in range(20)}
    assert len(others) > 1


def test_training_lowers_the_held_out_error(dataset, encoder):
    untrained = train(dataset, Training(8, epochs=1, learning_rate=0))
    error, before = (e.header["metrics"]["held_out_mse"] for e in (encoder, untrained))
    assert error < before / 4
    assert encoder.header["metrics"]["held_out_rows"] == 1000


def test_the_reported_error_is_that_of_encode_and_decode(dataset, encoder):
    _, test_rows = dataset.split()
    scaled = dataset.task.scale(dataset.columns["observation"][test_rows])
    lost = 2 * (encoder.decode(encoder(scaled)) - scaled) / (encoder.high - encoder.low)
    expected = encoder.header["metrics"]["held_out_mse"]
    assert np.mean(lost**2) == pytest.approx(expected, rel=1e-3)


def test_scaling_is_fitted_on_the_training_part_only(dataset, encoder):
    train_rows, _ = dataset.split()
    scaled = dataset.task.scale(dataset.columns["observation"][train_rows].astype(float))
    np.testing.assert_allclose(encoder.low, scaled.min(axis=0), rtol=1e-6)
    np.testing.assert_allclose(encoder.high, scaled.max(axis=0), rtol=1e-6)


def test_equal_seeds_give_equal_weights(dataset):
    def weights(seed):
        torch.manual_seed(99)  # what the caller did before must not matter
        return train(dataset, Training(4, epochs=2, batch_size=500, seed=seed)).encoder_weight

    np.testing.assert_array_equal(weights(1), weights(1))
    assert not np.array_equal(weights(1), weights(2))


def test_the_file_gives_the_same_encoder_back(encoder, tmp_path):
    encoder.save(tmp_path / "encoder")
    again = Encoder.load(tmp_path / "encoder")
    rows = np.random.default_rng(0).normal(size=(7, 16)).astype(np.float32)
    np.testing.assert_array_equal(encoder(rows), again(rows))
    assert again(rows).dtype == np.float32
    assert again(rows).shape == (7, 8)
    assert again.header == encoder.header


def test_a_damaged_encoder_file_is_refused(encoder, tmp_path):
    path = tmp_path / "encoder"
    with pytest.raises(InputError, match="no encoder at"):
        Encoder.load(path)
    encoder.save(path)
    whole = path.read_bytes()
    for damaged in (b"", whole[:100], whole[:-4], b"PK" + whole[2:]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="is not a jbrep encoder"):
            Encoder.load(path)


def test_a_tensor_of_another_shape_is_named(encoder):
    with pytest.raises(InputError, match=r"tensor decoder_bias has shape \(3,\): \(16,\)"):
        Encoder(**{**vars(encoder), "decoder_bias": np.zeros(3, np.float32)})


def test_mistakes_are_named(dataset, encoder, folder, tmp_path):
    with pytest.raises(InputError, match="latent size is 17: face_direction has 16 features"):
        train(dataset, Training(17))
    with pytest.raises(InputError, match="no data set in"):
        Dataset(tmp_path)
    with pytest.raises(InputError, match="holds a data set already"):
        collect(Collection("face_direction", 1000), folder)
    with pytest.raises(InputError, match="number of steps is 0"):
        collect(Collection("face_direction", 0), tmp_path)
    with pytest.raises(InputError, match="trained on face_direction, whose features differ"):
        encoder.check_task("move_to_pose", TASKS["move_to_pose"].feature_names)
    collect(Collection("face_direction", 1000), tmp_path / "one")
    with pytest.raises(InputError, match="1 episode can't be split"):
        Dataset(tmp_path / "one").split()
