"""Autoencoders: training, their file, and what they refuse."""

import numpy as np
import pytest
import torch
from small import settings

from jbrep.collect import collect
from jbrep.dae import Training, train
from jbrep.dataset import Dataset
from jbrep.encoders import Encoder
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS


@pytest.fixture(scope="module")
def dataset(collected):
    return Dataset(collected)


@pytest.fixture(scope="module")
def encoder(dataset):
    return train(dataset, Training(8, epochs=30, batch_size=100, learning_rate=5e-3))


def test_training_lowers_the_held_out_error(dataset, encoder):
    untrained = train(dataset, Training(8, epochs=1, learning_rate=0))
    error, before = (e.header["metrics"]["held_out_mse"] for e in (encoder, untrained))
    assert error < before / 4
    assert encoder.header["metrics"]["held_out_rows"] == 1000


def test_the_reported_error_is_that_of_encode_and_decode(dataset, encoder):
    _, test_rows = dataset.split()
    scaled = dataset.task.scale(dataset["observation"][test_rows])
    lost = 2 * (encoder.decode(encoder(scaled)) - scaled) / (encoder.high - encoder.low)
    expected = encoder.header["metrics"]["held_out_mse"]
    assert np.mean(lost**2) == pytest.approx(expected, rel=1e-3)


def test_scaling_is_fitted_on_the_training_part_only(dataset, encoder):
    train_rows, _ = dataset.split()
    scaled = dataset.task.scale(dataset["observation"][train_rows].astype(float))
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


def test_mistakes_are_named(dataset, encoder, tmp_path):
    with pytest.raises(InputError, match="latent size is 17: face_direction has 16 features"):
        train(dataset, Training(17))
    with pytest.raises(InputError, match="trained on face_direction, whose features differ"):
        encoder.check_task("move_to_pose", TASKS["move_to_pose"].feature_names)
    collect(settings(steps=1000), tmp_path / "one")
    with pytest.raises(InputError, match="1 episode can't be split"):
        train(Dataset(tmp_path / "one"), Training(8))
