"""Linear codes against their closed forms."""

import numpy as np
import pytest
from sklearn.decomposition import PCA

from jbrep.encoders.layers import run
from jbrep.methods.controls import Random
from jbrep.methods.linear import principal_code


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
