"""Scalings, coordinates, limits and features around the layers, in every library."""

import numpy as np
import onnxruntime
import pytest
import torch
from wide import make_feature, make_task

from jbrep.coordinates import make_coordinates, wrapped
from jbrep.dataset import Column, Scaler
from jbrep.dataset.scaling import fit_scaler
from jbrep.encoders import Encoder, Layer, load, save
from jbrep.encoders.header import EncoderHeader
from jbrep.encoders.onnx import export
from jbrep.envs import describe
from jbrep.errors import InputError

RANDOM = np.random.default_rng(0)
TASK = describe("face_direction")
ANGLES = (13, 15)


def column(values):
    return Column(lambda shard: values, [len(values)], values.dtype, values.shape[1:])


ROWS = RANDOM.normal(size=(2001, 3))
ROWS[:, 1] = 0.03  # constant
ROWS[:, 2] = 1e6 + 1e-1 * ROWS[:, 2]
ROWS = ROWS.astype(np.float32)
ROBOT = make_task(make_feature(f"obs_{i}", low=-i - 1, high=2) for i in range(3))


def deviations(rows):
    mean, reach = rows.mean(axis=0), 3 * rows.std(axis=0)
    return mean - reach, mean + reach


def quantiles(rows):
    low, median, high = np.quantile(rows, (0.01, 0.5, 0.99), axis=0)
    return median - (high - low) / 2, median + (high - low) / 2


@pytest.mark.parametrize(
    ("scaling", "formula"),
    [
        ("extrema", lambda rows: (rows.min(axis=0), rows.max(axis=0))),
        ("nominal", lambda rows: ((-1, -2, -3), (2, 2, 2))),
        ("standard", deviations),
        ("robust", quantiles),
    ],
)
def test_scalings_are_their_formulas_also_of_constant_and_far_features(scaling, formula):
    chosen = np.arange(0, 2001, 2)  # the others don't count
    scaler = fit_scaler(scaling, ROBOT, column(ROWS), chosen)
    low, high = formula(ROWS[chosen].astype(float))
    near = (1e-5, 1e-6, 0.07)  # a float32 can't tell more of 1e6
    assert (np.abs(np.subtract((scaler.low, scaler.high), (low, high))) < near).all()
    scaled = scaler.scale(ROWS)
    assert np.isfinite(scaled).all()
    if scaling != "nominal":
        np.testing.assert_array_equal(scaled[:, 1], 0)
        assert 0.9 < np.abs(scaled[:, 2]).max() < 3


def test_a_feature_that_is_nearly_always_the_same_is_no_constant():
    rows = np.zeros((2001, 1), np.float32)
    rows[::500] = 500  # a contact's force
    some = make_task([make_feature("force")])
    scaler = fit_scaler("robust", some, column(rows), np.arange(2001))
    assert (scaler.low[0], scaler.high[0]) == (-500, 500)


def test_a_task_without_usual_ranges_has_no_nominal_scaling():
    some = make_task([make_feature("known", low=0, high=1), make_feature("free")])
    with pytest.raises(InputError, match="free has no usual range"):
        fit_scaler("nominal", some, column(ROWS[:, :2]), np.arange(9))


def layer(inputs, outputs, activation):
    weight = RANDOM.normal(size=(outputs, inputs)) / np.sqrt(inputs)
    return Layer(weight.astype(np.float32), np.float32([0.1] * outputs), activation)


def encoder(on="angles", clip=1.5, keep=("angle_to_target", "velocity_x"), layers=True):
    """From 16 features to a code of 3 and what is kept, and back."""
    coordinates = make_coordinates(TASK, on)
    features = coordinates.features if coordinates else TASK.features
    ends = np.float32([(feature.low, feature.high) for feature in features]).T
    scaler = Scaler(*ends, coordinates, clip)
    metrics = {"held_out_mse": 0.1}
    header = EncoderHeader(kind="dae", name="it-3", environment=TASK, metrics=metrics)
    parts = (layer(scaler.size, 3, "tanh"),), (layer(3, scaler.size, "tanh"),)
    return Encoder(header, scaler, *(parts if layers else ((), ())), keep if layers else ())


def difference(rows, others):
    """In half widths, of angles the shorter way round."""
    off = (rows - others).astype(np.float64)
    off[:, ANGLES] = wrapped(off[:, ANGLES])
    return np.abs(off / TASK.unscale(np.ones(16)).clip(0.05))


VARIANTS = (
    {},
    {"on": "observation", "clip": None},
    {"clip": None, "layers": False},
    {"on": "coordinates", "clip": None, "keep": ("velocity", "motor_angle.sin")},
    {"on": "symmetry", "clip": None, "layers": False},
)


@pytest.mark.parametrize("changes", VARIANTS)
def test_numpy_torch_and_onnx_agree_beyond_the_ranges_too(changes, tmp_path):
    it = encoder(**changes)
    save(it, tmp_path / "it")
    again = load(tmp_path / "it")
    assert again.fingerprint == it.fingerprint
    assert again.header == it.header
    rows = TASK.unscale(3 * RANDOM.normal(size=(500, 16))).astype(np.float32)
    rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
    rows[1, list(ANGLES)] = (np.pi, -np.pi / 2)
    code, back = it.encode(rows), it.decode(it.encode(rows))
    given = torch.from_numpy(rows).requires_grad_()
    there = again.encode(given)
    again.decode(there).sum().backward()
    assert given.grad.isfinite().all()
    export(again, tmp_path / "it.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    latent, reconstruction = session.run(None, {"observation": rows})
    for theirs in (there.detach().numpy(), latent):
        np.testing.assert_allclose(theirs, code, rtol=1e-5, atol=1e-5)
    for theirs in (again.decode(there).detach().numpy(), reconstruction):
        assert difference(theirs, back).max() < 1e-4
    mine = Encoder.from_onnx(tmp_path / "it.onnx", TASK, None, "mine")
    np.testing.assert_allclose(mine.encode(rows), latent, rtol=1e-6, atol=1e-6)
    assert difference(mine.decode(latent), reconstruction).max() < 1e-5


def test_atan2_of_onnx_in_every_direction(tmp_path):
    it = encoder(clip=None, layers=False)
    export(it, tmp_path / "it.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    rows = np.zeros((4001, 16), np.float32)
    rows[:, 13] = np.linspace(-np.pi, np.pi, 4001)
    _, back = session.run(None, {"observation": rows})
    off = np.angle(np.exp(1j * (back[:, 13].astype(float) - rows[:, 13])))
    assert np.abs(off).max() < 1e-6


def test_an_observation_survives_sine_and_cosine_and_what_is_kept_survives_the_layers():
    rows = TASK.unscale(RANDOM.uniform(-1, 1, (200, 16))).astype(np.float32)
    whole = encoder(clip=None, layers=False)
    assert whole.latent_size == 18
    assert difference(whole.decode(whole.encode(rows)), rows).max() < 1e-5
    it = encoder()
    assert it.latent_size == 3 + 3  # an angle is two numbers
    code = it.encode(rows)
    np.testing.assert_array_equal(code[:, 3:], it.scaler.scale(rows)[:, it.kept])
    lost = difference(it.decode(code), rows)
    assert lost[:, [7, 15]].max() < 1e-5
    assert lost[:, 0].max() > 0.1
    many = rows * np.float32(1e4)
    assert np.abs(it.scaler.scale(many)).max() == np.float32(1.5)
