"""Encoders: their arithmetic, their file, what they refuse, and the ones that ship."""

import io
import json
import os
import pickle
import struct

import numpy as np
import onnxruntime
import pytest
import safetensors.numpy
import torch
from small import flip_bit

from jbrep.coordinates import make_coordinates
from jbrep.dataset import Scaler
from jbrep.encoders import Encoder, Layer, find, load, save
from jbrep.encoders.header import EncoderHeader
from jbrep.encoders.layers import dense, run
from jbrep.encoders.onnx import export
from jbrep.encoders.shipped import names, source_of
from jbrep.envs import Feature, Task, describe
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS
from jbrep.methods.fit import Fitter, complete
from jbrep.methods.linear import lost as lost_rows
from jbrep.records.record import from_plain
from jbrep.training.method import Made
from jbrep.training.network import ARCHITECTURES, layers, stacks

TASK = describe("face_direction")
PENDULUM = describe("Pendulum-v1", {"g": 1.6})
RANDOM = np.random.default_rng(0)


def layer(inputs, outputs, activation):
    weight, bias = RANDOM.normal(size=(outputs, inputs)), RANDOM.normal(size=outputs)
    return Layer(weight.astype(np.float32), bias.astype(np.float32), activation)


def make():
    facts = {"kind": "dae", "name": "dae-3", "training": {"latent": 3}, "data": {"seed": 0}}
    header = EncoderHeader(**facts, environment=TASK, metrics={"held_out_mse": 0.1})
    low = -np.arange(1, 17, dtype=np.float32)
    parts = (layer(16, 5, "relu"), layer(5, 3, "tanh")), (layer(3, 16, "linear"),)
    return Encoder(header, Scaler(low, 2 - low), *parts)


def numbered(size, **features):
    """A task of which nothing is known but the size of its observations."""
    named = tuple(Feature(f"obs_{i}", **features) for i in range(size))
    return Task(f"Robot{size}-v0", f"Robot{size}-v0", named, (-1.0,), (1.0,), 1000)


@pytest.fixture
def encoder():
    return make()


def observations(*shape):
    return RANDOM.normal(size=(*shape, 16)).astype(np.float32)


def test_encode_scales_and_runs_the_layers(encoder):
    rows = observations(7)
    (first, second), (last,) = encoder.encoder, encoder.decoder
    scaled = (rows - 1) / (np.arange(1, 17) + 1)
    hidden = np.maximum(scaled @ first.weight.T + first.bias, 0)
    latent = np.tanh(hidden @ second.weight.T + second.bias)
    np.testing.assert_allclose(encoder.encode(rows), latent, rtol=1e-4, atol=1e-6)
    back = (latent @ last.weight.T + last.bias) * (np.arange(1, 17) + 1) + 1
    np.testing.assert_allclose(encoder.decode(encoder(rows)), back, rtol=1e-4, atol=1e-4)
    assert (encoder.size, encoder.latent_size, encoder.name) == (16, 3, "dae-3")


@pytest.mark.parametrize("shape", [(), (2, 3), (0,)])
def test_numpy_and_torch_agree_in_float32_at_any_shape(encoder, shape):
    rows = observations(*shape)
    latent = encoder.encode(rows)
    assert (latent.shape, latent.dtype) == ((*shape, 3), np.float32)
    assert encoder.encode(rows.astype(np.float64)).dtype == np.float32
    tensor = encoder.encode(torch.from_numpy(rows))
    assert tensor.dtype == torch.float32
    np.testing.assert_allclose(tensor.numpy(), latent, rtol=1e-4, atol=1e-6)
    back = encoder.decode(tensor)
    assert back.shape == (*shape, 16)
    np.testing.assert_allclose(back.numpy(), encoder.decode(latent), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("on", [None, "symmetry"])
def test_gradients_flow_after_a_first_use_without_them(on):
    encoder = make() if on is None else find("symmetry", TASK).with_header(name="anew")
    with torch.inference_mode():
        encoder.encode(torch.from_numpy(observations(2)))
    rows = torch.from_numpy(observations(20)).requires_grad_()
    encoder.encode(rows).sum().backward()
    assert rows.grad.any()


def test_the_file_gives_the_same_encoder_back(encoder, tmp_path):
    save(encoder, tmp_path / "one")
    again = load(tmp_path / "one")
    save(again, tmp_path / "two")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert again.header == encoder.header
    assert again.fingerprint == encoder.fingerprint
    rows = observations(5)
    np.testing.assert_array_equal(encoder(rows), again(rows))
    np.testing.assert_array_equal(encoder.decode(again(rows)), again.decode(encoder(rows)))


def test_any_changed_bit_is_refused(encoder, tmp_path):
    path = tmp_path / "encoder"
    save(encoder, path)
    for bit in RANDOM.choice(8 * path.stat().st_size, 60, replace=False):
        flip_bit(path, bit)
        with pytest.raises(InputError, match="encoder"):
            load(path)
        flip_bit(path, bit)


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def test_what_is_no_encoder_is_refused_and_nothing_in_it_is_run(encoder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, stream = tmp_path / "encoder", io.BytesIO()
    with pytest.raises(InputError, match="no encoder at"):
        load(path)
    save(encoder, path)
    whole, bomb = path.read_bytes(), pickle.dumps(Bomb())
    torch.save({"low": torch.zeros(16)}, stream)
    other = safetensors.numpy.save({"low": np.zeros(16, np.float32)})
    in_header = struct.pack("<Q", 100) + bomb.ljust(100)
    damaged = (b"", whole[:100], whole[:-4], whole + b"x", stream.getvalue(), other)
    for content in (*damaged, bomb, in_header):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is not a jbrep encoder"):
            load(path)
    assert not (tmp_path / "exploded").exists()


def test_what_needs_no_data_is_made_of_renamed_or_shifted_features():
    """Where what ships for the task was made for others."""
    first, *others = TASK.features
    renamed = TASK.replace(features=(first.replace(name="x"), *others))
    for task in (renamed, TASK.replace(offsets={"position_x": 0.5})):
        assert find("full", task).task == task
        assert source_of("full", task).startswith("full, ")
        with pytest.raises(InputError, match="pca-8 was made for "):
            find("pca-8", task)
    assert find("full", TASK).header.data  # this ships


def test_a_model_of_onnx_says_its_task_and_overwrites_nothing(encoder, tmp_path):
    """What it computes, test_scaling.py compares."""
    export(encoder, tmp_path / "it.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    stored = session.get_modelmeta().custom_metadata_map["jbrep"]
    assert from_plain(json.loads(stored)["environment"], Task) == TASK
    with pytest.raises(InputError, match=r"it.onnx exists already"):
        export(encoder, tmp_path / "it.onnx")


@pytest.mark.parametrize("name", TASKS)
def test_encoders_ship_for_every_task_of_the_jitterbug(name):
    task = describe(name)
    kinds = ("dae", "forward", "linear-forward", "pca", "random")
    sizes = [f"{kind}-{latent}" for kind in kinds for latent in (12, 8, 4)]
    assert names(task) == ("coordinates", *sizes[:6], "full", *sizes[6:], "symmetry")
    errors = {}
    for name in names(task):
        encoder = find(name, task)
        assert encoder.task == task
        source = encoder.header.data
        if encoder.scaler.coordinates:
            assert source["seed"] == 1_000_000  # no run begins there
            assert encoder.header.metrics["held_out_mse"] < 1e-12
            continue
        assert source["train_rows"] + source["test_rows"] == 5_000_000
        like = "linear-forward-8" if "forward" in name else "full"  # of another CPU's rounding
        assert source["fingerprint"] == find(like, task).header.data["fingerprint"]
        errors[name] = encoder.header.metrics["held_out_mse"]
        if encoder.kind == "dae":
            assert encoder.header.training["epochs"] == encoder.header.metrics["epochs"] == 200
    for kind in ("dae", "pca", "random"):
        assert errors["full"] < errors[f"{kind}-12"] < errors[f"{kind}-8"] < errors[f"{kind}-4"]


@pytest.mark.parametrize(
    ("task", "source", "reading"),
    [
        (PENDULUM, "full, scaled by the usual ranges", (1, 1, 8)),
        (numbered(3, low=-1e20, high=1e20), "full, unscaled", (1, 1, 1)),
        (numbered(3, low=1.0, high=1.0 + 1e-12), "full, unscaled", (1, 1, 1)),
        (
            numbered(2).replace(features=(Feature("x", "m", -2.0, 4.0), Feature("y"))),
            "full, scaled by the usual ranges where they are known",
            (4, 1),
        ),
    ],
)
def test_the_full_observation_of_any_task(task, source, reading, tmp_path):
    """It is scaled where it can be, and says whether it is."""
    full = find("full", task)
    assert source_of("full", task) == source
    np.testing.assert_array_equal(full(np.array(reading)), np.ones(task.size))
    assert (full.name, full.kind, full.task) == ("full", "full", task)
    save(full, tmp_path / "it")
    assert load(tmp_path / "it").fingerprint == find("full", task).fingerprint


def test_a_name_that_ships_takes_precedence_over_a_file(encoder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(encoder, tmp_path / "dae-8")
    assert (find("full", TASK).kind, source_of("full", TASK)) == ("full", "full, shipped")
    assert source_of("dae-8", TASK) == "dae-8, shipped"
    assert source_of("./dae-8", TASK) == "./dae-8"
    assert find("dae-8", TASK).latent_size == 8
    assert find("./dae-8", TASK).latent_size == 3
    for name, task in (("dae-9", TASK), ("dae-8", PENDULUM), ("./dae-8", PENDULUM)):
        with pytest.raises(InputError, match="dae-"):
            find(name, task)


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


@pytest.mark.parametrize("codes", ["standard", "white"])
def test_a_unit_that_says_nothing_stays_so(data, rows, codes):
    weight = np.random.default_rng(0).normal(size=(3, data.size))
    weight[1] = 0
    dead = Made((dense(weight, np.ones(3)),))
    encoder, decoder, _ = complete(dead, data, codes)
    code = run(encoder, rows)
    np.testing.assert_allclose(code[:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(code.std(axis=0)[[0, 2]], 1 / 3, rtol=1e-3)
    assert np.isfinite(run(decoder, code)).all()


def test_units_that_depend_on_others_are_whitened_but_for_rounding(data, rows):
    weight = 100 * np.random.default_rng(0).normal(size=(3, data.size))
    weight[2] = weight[0] + weight[1]
    encoder, *_ = complete(Made((dense(weight, np.zeros(3)),)), data, "white")
    spread = np.linalg.eigvalsh(np.cov(run(encoder, rows).astype(float).T))
    np.testing.assert_allclose(spread, [0, 1 / 9, 1 / 9], atol=1e-3)


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
