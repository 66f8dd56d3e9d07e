"""Linear codes against their closed forms; controls: some features, noise, random directions."""

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from jbrep.encoders.layers import run
from jbrep.methods.controls import Random
from jbrep.methods.fit import Fitter
from jbrep.methods.linear import principal_code


def projection(data, latent, seed):
    return Random(latent=latent, seed=seed).make(data)[:2]


@pytest.fixture(scope="module")
def rows(data):
    return data.load(data.train)


def error(parts, rows):
    """Mean squared error of reconstructions."""
    encoder, decoder = parts
    return np.mean((run(decoder, run(encoder, rows)) - rows) ** 2)


def test_moments_are_those_of_the_training_rows(data, rows):
    np.testing.assert_allclose(data.moments.mean, rows.mean(axis=0, dtype=float), atol=1e-9)
    expected = np.cov(rows.T.astype(float), bias=True)
    np.testing.assert_allclose(data.moments.covariance, expected, atol=1e-9)


@pytest.mark.parametrize("latent", [1, 4, 8, 12])
def test_pca_is_scikit_learns_and_loses_the_smallest_variances(data, rows, latent):
    theirs = PCA(latent).fit(rows.astype(float))
    reference = theirs.inverse_transform(theirs.transform(rows.astype(float)))
    ours = error(principal_code(data, latent), rows)
    assert ours == pytest.approx(np.mean((reference - rows) ** 2), rel=1e-4)
    dropped = np.linalg.eigvalsh(data.moments.covariance)[: 16 - latent]
    assert ours == pytest.approx(dropped.sum() / 16, rel=1e-4)


def test_a_random_projection_is_orthonormal_and_its_decoder_the_best(data, rows):
    (encoder,), (decoder,) = projection(data, 5, seed=1)
    np.testing.assert_allclose(encoder.weight @ encoder.weight.T, np.eye(5), atol=1e-6)
    latent = np.column_stack((run((encoder,), rows), np.ones(len(rows)))).astype(float)
    least = np.linalg.lstsq(latent, rows.astype(float), rcond=None)[1].sum() / rows.size
    assert error(((encoder,), (decoder,)), rows) == pytest.approx(least, rel=1e-4)
    same, other = (projection(data, 5, seed)[0][0].weight for seed in (1, 2))
    np.testing.assert_array_equal(encoder.weight, same)
    assert not np.array_equal(encoder.weight, other)


@pytest.fixture(scope="module")
def fit(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("controls")
    return lambda kind, **settings: Fitter(data, folder).fit(kind, **settings).encoder


@pytest.fixture(scope="module")
def observations(data):
    return data.dataset["observation"][:]


def test_a_subset_is_the_scaled_features_in_order(data, fit, observations):
    encoder = fit("subset", features="motor_angle, velocity_*")
    names = ("velocity_x", "velocity_y", "velocity_z", "motor_angle")
    places = [data.task.feature_names.index(name) for name in names]
    assert encoder.name == "subset-4"
    assert encoder.header.training["features"] == list(names)
    scaled = data.scale(observations)
    np.testing.assert_array_equal(encoder.encode(observations), scaled[:, places])
    back = data.scale(encoder.decode(scaled[:, places]))
    np.testing.assert_allclose(back[:, places], scaled[:, places], atol=1e-5)


def test_a_subset_of_an_angle_is_its_sine_and_cosine(fit, observations):
    encoder = fit("subset", features="motor_angle", on="angles", scaling="nominal")
    angle = observations[:, 13]
    expected = np.column_stack((np.cos(angle), np.sin(angle)))
    np.testing.assert_allclose(encoder.encode(observations), expected, atol=1e-6)


def test_noise_is_beside_all_features_and_unrelated_to_them_and_to_itself(data, fit, observations):
    encoder = fit("noise", latent=24)
    latent = encoder.encode(observations)
    assert encoder.name == "noise-24"
    assert latent.shape[1] == encoder.latent_size == 24
    noise, features = latent[:, :8], latent[:, 8:]
    np.testing.assert_array_equal(features, data.scale(observations))
    np.testing.assert_allclose(encoder.decode(latent), observations, atol=2e-4)
    assert encoder.header.metrics["held_out_mse"] < 1e-12
    related = np.abs(np.corrcoef(latent.T) - np.eye(24))[:8]
    assert related.max() < 0.08  # 5 deviations of 5000 unrelated values are 0.07
    steps = np.corrcoef(np.hstack((noise[1:], noise[:-1])).T)[:8, 8:]
    assert np.abs(steps).max() < 0.08
    np.testing.assert_allclose(noise.std(axis=0), np.sqrt(0.5), atol=0.02)
    in_torch = encoder.encode(torch.from_numpy(observations)).numpy()
    np.testing.assert_allclose(in_torch, latent, atol=2e-3)
