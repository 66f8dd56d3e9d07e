"""What every code can have: a linear decoder, a scale, features that pass around it."""

import numpy as np
import pytest

from jbrep.coordinates import make_coordinates
from jbrep.encoders import Encoder
from jbrep.encoders.layers import dense, run
from jbrep.errors import InputError
from jbrep.methods.fit import Fitter, complete
from jbrep.methods.linear import lost as lost_rows
from jbrep.training.method import Made
from jbrep.training.network import ARCHITECTURES, layers, stacks


@pytest.fixture(scope="module")
def rows(data):
    return data.load(data.train)


@pytest.fixture(scope="module")
def made(data):
    """A nonlinear code of 4 units with its decoder."""
    return Made(*map(layers, stacks(ARCHITECTURES["paper"], data.size, 4, seed=0)))


@pytest.mark.parametrize("codes", ["standard", "white"])
def test_units_have_the_deviation_that_they_say_and_decode_alike(data, rows, made, codes):
    encoder, decoder, _ = complete(made, data, codes)
    code = run(encoder, rows).astype(float)
    np.testing.assert_allclose(code.mean(axis=0), 0, atol=1e-4)
    covariance = np.cov(code.T, bias=True)
    np.testing.assert_allclose(np.diag(covariance), 1 / 9, rtol=1e-3)
    correlated = np.abs(covariance - np.diag(np.diag(covariance))).max() > 1e-3
    assert correlated == (codes == "standard")
    before = run(made.decoder, run(made.encoder, rows))
    np.testing.assert_allclose(run(decoder, code.astype(np.float32)), before, atol=1e-4)


def test_the_linear_decoder_is_the_best(data, rows, made):
    encoder, decoder, _ = complete(Made(made.encoder), data)
    assert encoder is made.encoder
    code = run(encoder, rows)
    wide = np.column_stack((code, np.ones(len(rows)))).astype(float)
    best = np.linalg.lstsq(wide, rows.astype(float), rcond=None)[0]
    np.testing.assert_allclose(run(decoder, code), wide @ best, atol=1e-4)


def test_a_unit_that_says_nothing_can_be_scaled_but_not_whitened(data, rows, made):
    weight = np.random.default_rng(0).normal(size=(3, data.size))
    weight[1] = 0
    dead = Made((dense(weight, np.ones(3)),))
    encoder, decoder, _ = complete(dead, data, "standard")
    code = run(encoder, rows)
    np.testing.assert_allclose(code[:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(code.std(axis=0)[[0, 2]], 1 / 3, rtol=1e-3)
    assert np.isfinite(run(decoder, code)).all()
    with pytest.raises(InputError, match="the covariance of the code is singular") as refused:
        complete(dead, data, "white")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("kind", "on"), [("pca", "observation"), ("slow", "angles"), ("dae", "observation")]
)
def test_what_is_kept_passes_exactly_and_the_method_never_saw_it(data, kind, on, tmp_path):
    keep, angles = ("angle_to_target", "velocity_x"), 2 * (on == "angles")
    how = {"epochs": 1} if kind == "dae" else {}
    fitted = Fitter(data, tmp_path).fit(kind, latent=4, keep="velocity_x,angle_*", on=on, **how)
    it: Encoder = fitted.encoder
    assert all(name.startswith(keep) for name in it.header.keep)
    assert it.latent_size == 4 + 2 + angles // 2
    observed = data.dataset["observation"][data.test]
    code, scaled = it.encode(observed), it.scaler.scale(observed)
    np.testing.assert_array_equal(code[:, 4:], scaled[:, it.kept])
    other = observed.copy()
    other[:, [7, 15]] += 0.5
    np.testing.assert_array_equal(it.encode(other)[:, :4], code[:, :4])
    assert not it.encoder[0].weight[:, it.kept].any()
    lost = lost_rows(it, observed, data)
    assert np.abs(lost[:, [7, 15]]).max() < 1e-5
    rest = data.rescaled(coordinates=make_coordinates(data.task, on), without=keep)
    assert len(rest.names) == rest.size == 14 + angles // 2
    assert not any(name.startswith(keep) for name in rest.names)
