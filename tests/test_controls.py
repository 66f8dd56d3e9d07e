"""Linear codes against their closed forms."""

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA
from torch import nn

from jbrep.dae.autoencoder import Gradient
from jbrep.dataset.scaled import Moments
from jbrep.encoders.layers import run
from jbrep.methods.controls import Random
from jbrep.methods.linear import dense, linear_code, principal_code


def projection(data, latent, seed):
    return Random(latent=latent, seed=seed).make(data)[:2]


@pytest.fixture(scope="module")
def rows(data):
    return data.load(data.train)


def error(parts, rows, noise=0.0, seed=0):
    """Mean squared error of reconstructions of corrupted rows from clean ones."""
    drawn = noise * np.random.default_rng(seed).normal(size=rows.shape)
    encoder, decoder = parts
    return np.mean((run(decoder, run(encoder, (rows + drawn).astype(np.float32))) - rows) ** 2)


def expected_error(parts, moments, noise):
    """The same in expectation over rows and noise, for a linear code."""
    (encoder,), (decoder,) = parts
    both = decoder.weight.astype(float) @ encoder.weight.astype(float)
    lost = both - np.eye(len(both))
    shift = lost @ moments.mean + decoder.weight @ encoder.bias + decoder.bias
    spread = np.trace(lost @ moments.covariance @ lost.T) + noise**2 * np.square(both).sum()
    return (spread + shift @ shift) / len(both)


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


def test_no_linear_code_beats_principal_code(data, rows):
    best = error(principal_code(data, 6), rows)
    for seed in range(20):
        assert error(projection(data, 6, seed), rows) > best
        weight = np.random.default_rng(seed).normal(size=(6, 16))
        assert error(linear_code(weight, data.moments), rows) > best


def test_a_random_projection_is_orthonormal_and_its_decoder_the_best(data, rows):
    (encoder,), (decoder,) = projection(data, 5, seed=1)
    np.testing.assert_allclose(encoder.weight @ encoder.weight.T, np.eye(5), atol=1e-6)
    latent = np.column_stack((run((encoder,), rows), np.ones(len(rows)))).astype(float)
    least = np.linalg.lstsq(latent, rows.astype(float), rcond=None)[1].sum() / rows.size
    assert error(((encoder,), (decoder,)), rows) == pytest.approx(least, rel=1e-4)
    same, other = (projection(data, 5, seed)[0][0].weight for seed in (1, 2))
    np.testing.assert_array_equal(encoder.weight, same)
    assert not np.array_equal(encoder.weight, other)


def train_linear(rows, latent, noise, steps):
    """A linear autoencoder, trained on the whole at each step."""
    torch.manual_seed(0)
    stack = nn.Sequential(nn.Linear(rows.shape[1], latent), nn.Linear(latent, rows.shape[1]))
    optimiser = torch.optim.Adam(stack.parameters(), 3e-3)
    gradient = Gradient(stack, len(rows))
    clean = torch.from_numpy(rows.T.copy())
    for _ in range(steps):
        gradient(clean + noise * torch.randn(clean.shape), clean)
        optimiser.step()
    return stack


def linear_denoiser(latent, noise, moments):
    """The linear code of that size with the least error in restoring clean rows from corrupted.

    Corruption adds noise of standard deviation `noise` to each feature. The best denoiser of full
    rank is ridge regression, B = C (C + noise^2 I)^-1; of rank l, it is B projected on the first l
    principal directions of its output B C (reduced-rank regression, Izenman 1975).
    """
    mean, covariance = moments
    corrupted = covariance + noise**2 * np.eye(len(mean))
    ridge = covariance @ np.linalg.pinv(corrupted, hermitian=True)
    _, vectors = np.linalg.eigh(ridge @ covariance)
    directions = vectors[:, ::-1][:, :latent]
    weight = directions.T @ ridge
    return (dense(weight, -weight @ mean),), (dense(directions, mean),)


def test_the_denoiser_bounds_a_linear_dae_that_comes_near_it():
    generator = np.random.default_rng(0)
    rows = (generator.normal(size=(4000, 3)) @ generator.normal(size=(3, 6)) / 3).astype(np.float32)
    moments = Moments(rows.mean(axis=0, dtype=float), np.cov(rows.T.astype(float), bias=True))
    bound = expected_error(linear_denoiser(2, 0.3, moments), moments, 0.3)
    parts = [
        (type("L", (), {"weight": m.weight.detach().numpy(), "bias": m.bias.detach().numpy()}),)
        for m in train_linear(rows, 2, 0.3, 1500)
    ]
    trained = expected_error(parts, moments, 0.3)
    assert bound < trained < 1.02 * bound


def test_a_wide_linear_autoencoder_reconstructs():
    rows = np.random.default_rng(0).normal(size=(500, 5)).astype(np.float32)
    stack = train_linear(rows, 8, 0, 2500)
    with torch.no_grad():
        lost = (stack(torch.from_numpy(rows)) - torch.from_numpy(rows)).square().mean().item()
    assert lost < 1e-4
