"""Controls: some features, noise beside all of them, random directions, scalings of the whole."""

import numpy as np
import pytest
import torch

from jbrep.methods.fit import Fitter


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
    code = fit("subset", features="motor_angle", on="angles", scaling="nominal").encode(
        observations
    )
    angle = observations[:, 13]
    np.testing.assert_allclose(code, np.column_stack((np.cos(angle), np.sin(angle))), atol=1e-6)


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
