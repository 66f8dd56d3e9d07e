"""Networks from elsewhere, torch modules and ONNX models, and the activations of jbrep's own."""

import pickle
from itertools import pairwise

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from command import jbrep, mistake
from onnx import TensorProto, helper, numpy_helper
from small import ONE_EACH
from torch import nn
from torch.nn import functional

from jbrep.cli.encoders import card
from jbrep.dae import DAE
from jbrep.encoders import ACTIVATIONS, Encoder, Layer, find, load, save
from jbrep.encoders.layers import activate
from jbrep.encoders.onnx import export
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.methods.registry import name_of, read_name
from jbrep.rl import Run, train
from jbrep.rl.controller import export as export_policy
from jbrep.rl.controller import load_policy
from jbrep.rl.files import ENCODER
from jbrep.rl.policy import load_run
from jbrep.training.network import get_architecture

TASK = describe("face_direction")
RANDOM = np.random.default_rng(0)
ROWS = RANDOM.normal(size=(50, 16)).astype(np.float32)
TORCH = {
    "linear": lambda values: values,
    "relu": functional.relu,
    "tanh": torch.tanh,
    "sigmoid": torch.sigmoid,
    "gelu": functional.gelu,
    "silu": functional.silu,
    "elu": functional.elu,
    "leaky-relu": functional.leaky_relu,
    "sin": torch.sin,
    "avg-l1-norm": lambda values: values / values.abs().mean(-1, keepdim=True),
}


def given(function, rows=ROWS):
    """What a torch function makes of rows."""
    with torch.no_grad():
        return function(torch.from_numpy(rows)).numpy()


def played(path, rows=ROWS):
    """What onnxruntime makes of rows by a file, by the names of its outputs."""
    session = onnxruntime.InferenceSession(path)
    names = [each.name for each in session.get_outputs()]
    return dict(zip(names, session.run(names, {session.get_inputs()[0].name: rows}), strict=True))


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activations_are_torchs_and_never_overflow(name):
    near = np.linspace(-30, 30, 600, dtype=np.float32).reshape(3, -1)
    far = np.float32([[-1e30, -1e4, -90, 90, 1e4, 1e30]])
    for values in (near, far[:, 1:-1]):
        expected = given(TORCH[name], values)
        for result in (activate(name, values), activate(name, torch.from_numpy(values)).numpy()):
            np.testing.assert_allclose(result, expected, 1e-6, 1e-6)
            assert result.dtype == np.float32
    assert np.isfinite(activate(name, far)).all()


def test_an_encoder_with_every_activation_and_no_decoder_as_a_file_and_as_onnx(tmp_path):
    sizes = [16, *range(len(ACTIVATIONS) + 2, 2, -1)]
    layers = [
        Layer(f32(out, size), f32(out), activation)
        for (size, out), activation in zip(pairwise(sizes), ACTIVATIONS, strict=True)
    ]
    like = find("dae-8", TASK)
    encoder = Encoder(like.header.replace(name="mine"), like.scaler, tuple(layers), ())
    save(encoder, tmp_path / "it")
    again = load(tmp_path / "it")
    assert (again.fingerprint, again.header) == (encoder.fingerprint, encoder.header)
    assert not again.can_decode
    np.testing.assert_array_equal(again(ROWS), encoder(ROWS))
    export(again, tmp_path / "it.onnx")
    latent = played(tmp_path / "it.onnx")["latent"]
    np.testing.assert_allclose(latent, encoder(ROWS), rtol=1e-3, atol=1e-4)
    assert "decoder     none" in card(again, "it", 80)


class Branched(nn.Module):
    """Attention between two branches, beside some features as they are; with decode."""

    def __init__(self):
        super().__init__()
        self.left, self.right = nn.Linear(16, 8), nn.Linear(16, 8)
        self.between = nn.MultiheadAttention(8, 2, batch_first=True)
        self.norm, self.drop, self.back = nn.BatchNorm1d(8), nn.Dropout(0.9), nn.Linear(10, 16)

    def encode(self, x):
        both = torch.stack((self.left(x), self.right(x)), 1)
        mixed, _ = self.between(both, both, both)
        gated = self.norm(self.drop(mixed.mean(1))) * functional.mish(self.left(x))
        return torch.cat((gated, x[:, :2] ** 2), 1)

    def decode(self, z):
        return self.back(z)


@pytest.fixture(scope="module")
def module():
    torch.manual_seed(1)
    return Branched()


@pytest.fixture(scope="module")
def encoder(module):
    return Encoder.from_torch(module, "face_direction", name="mine")


def test_a_torch_module_of_any_graph_becomes_an_encoder_and_stays_as_it_is(module, encoder):
    assert module.training
    module.eval()
    latent = given(module.encode)
    np.testing.assert_allclose(encoder(ROWS), latent, rtol=1e-5, atol=1e-5)
    back = given(module.decode, latent)
    np.testing.assert_allclose(encoder.decode(latent), back, rtol=1e-5, atol=1e-5)
    module.train()
    assert (encoder.kind, encoder.name, encoder.task) == ("imported", "mine", TASK)
    np.testing.assert_array_equal(given(encoder), encoder(ROWS))  # as tensors
    for shape in ((16,), (2, 25, 16), (0, 16)):
        assert encoder(np.resize(ROWS, shape)).shape == (*shape[:-1], 10)
    with pytest.raises(InputError, match="takes observations of 16 numbers"):
        encoder(ROWS[:, :15])


def test_its_file_gives_the_same_encoder_back_also_in_another_process(encoder, tmp_path):
    save(encoder, tmp_path / "it")
    again = load(tmp_path / "it")
    assert again.fingerprint == encoder.fingerprint
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(again))(ROWS), encoder(ROWS))
    export(again, tmp_path / "it.onnx")
    made = played(tmp_path / "it.onnx")
    np.testing.assert_allclose(made["latent"], encoder(ROWS), rtol=1e-6, atol=1e-6)
    back = encoder.decode(made["latent"])
    np.testing.assert_allclose(made["reconstruction"], back, rtol=1e-6, atol=1e-6)
    assert "10 onnx" in card(again, "it", 80)


@pytest.fixture(scope="module")
def run(encoder, tmp_path_factory):
    """A short run on it."""
    folder = tmp_path_factory.mktemp("runs")
    save(encoder, folder / "it.safetensors")
    task = describe("face_direction", episode_steps=20)
    file = str(folder / "it.safetensors")
    train(Run.of(task, "a2c", encoder=file, steps=20, preset="paper", **ONE_EACH), folder / "a")
    return folder / "a"


def test_a_run_on_it_keeps_it_and_its_policy_is_one_model(run, tmp_path):
    assert load(run / ENCODER).name == load_run(run).representation == "mine"
    policy = load_policy(run)
    export_policy(policy, tmp_path / "it.onnx")
    action = played(tmp_path / "it.onnx")["action"]
    np.testing.assert_allclose(action, policy(ROWS), rtol=1e-5, atol=1e-6)


class Wrong(nn.Module):
    def __init__(self, forward):
        super().__init__()
        self.first, self.does = nn.Linear(16, 3), forward

    def forward(self, x):
        return self.does(self, x)


@pytest.mark.parametrize(
    ("forward", "message"),
    [
        (lambda m, x: x if x.sum() > 0 else m.first(x), "Wrong can't be exported: "),
        (lambda m, x: (m.first(x), x), "Wrong has the outputs "),
        (lambda m, x: m.first(x) / 0, "not finite"),
        (lambda m, x: torch.randn_like(x), "other latents"),
    ],
)
def test_a_module_that_is_no_encoder_is_refused(forward, message):
    with pytest.raises(InputError, match=message) as refused:
        Encoder.from_torch(Wrong(forward), TASK)
    assert "\n" not in str(refused.value)


def test_what_jbrep_exports_comes_back_with_its_decoder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    task = ("--task", "face_direction")
    for name in ("dae-8", "symmetry"):
        like, file = find(name, TASK), f"{name}.onnx"
        jbrep("encoder", "export", name, *task, "--out", file)
        told = jbrep("encoder", "import", file, *task, "--out", f"mine-{name}").stdout
        assert told.startswith(f"mine-{name}\n")
        assert "kind        imported" in told
        mine = find(f"./mine-{name}", TASK)
        np.testing.assert_allclose(mine(ROWS), like(ROWS), rtol=1e-5, atol=1e-6)
        latent = like(ROWS)
        np.testing.assert_allclose(mine.decode(latent), like.decode(latent), 1e-5, 1e-5)
    command = ("encoder", "import", "dae-8.onnx", *task, "--out")
    assert "exists already" in mistake(*command, "mine-dae-8")
    assert "name is 'Mine'" in mistake(*command, "Mine")
    said = mistake(*command, "Mine", "--name", "other", "--decoder", "dae-8.onnx")
    assert "the input of dae-8.onnx is (rows, 16), expected floats (rows, 8)" in said


def node(line, **attributes):
    """A node from a line such as `c = Add a b`."""
    outputs, operation, *inputs = line.replace(" =", "").split()
    domain, _, name = operation.rpartition(":")
    return helper.make_node(name, inputs, outputs.split(","), domain=domain, **attributes)


def model(nodes, constants=None, inputs=("x", ("rows", 16)), outputs="y", opset=20, kind=1):
    """An ONNX model of nodes, or of lines `c = Add a b; d = Relu c`."""
    if isinstance(nodes, str):
        nodes = [node(line) for line in nodes.split("; ")]
    graph = helper.make_graph(
        nodes,
        "graph",
        [helper.make_tensor_value_info(inputs[0], kind, inputs[1])],
        [helper.make_tensor_value_info(name, kind, (None, None)) for name in outputs.split()],
        [numpy_helper.from_array(np.asarray(v), name) for name, v in (constants or {}).items()],
    )
    opsets = [helper.make_opsetid("", opset), helper.make_opsetid("mine", 1)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=9)


def f32(*shape):
    return RANDOM.normal(size=shape).astype(np.float32)


def branch(operation):
    """A branch of an If, which reads a value from outside."""
    made = helper.make_tensor_value_info("b", TensorProto.FLOAT, (None, 3))
    return helper.make_graph([node(f"b = {operation} a")], "branch", [], [made])


MODELS = {
    "branches": (
        [node("a = MatMul x w"), node("s = Sin a"), node("y = Concat s a x", axis=1)],
        {"w": f32(16, 3)},
    ),
    "condition": (
        [
            node("a = MatMul x w"),
            node("y = If c", then_branch=branch("Relu"), else_branch=branch("Neg")),
        ],
        {"w": f32(16, 3), "c": np.array(False)},
    ),
    "old operators": (
        [node("a = MatMul x w"), node("y = Softmax a", axis=1)],
        {"w": f32(16, 3)},
        ("x", ("rows", 16)),
        *("y", 11),
    ),
    "two rows": ("y = MatMul x w", {"w": f32(16, 3)}, ("x", (2, 16))),
    "float64": (
        "y = MatMul x w",
        {"w": np.eye(16)},
        ("x", ("n", "d")),
        "y",
        20,
        TensorProto.DOUBLE,
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_model_gives_what_onnxruntime_gives(name, tmp_path):
    made = model(*MODELS[name])
    made.graph.node[0].doc_string = "of /home/somebody"
    onnx.save(made, tmp_path / "it.onnx")
    kind = np.float64 if name == "float64" else np.float32
    parts = [played(tmp_path / "it.onnx", part)["y"] for part in np.split(ROWS.astype(kind), 25)]
    encoder = Encoder.from_onnx(tmp_path / "it.onnx", TASK, None, "mine")
    assert not encoder.can_decode
    np.testing.assert_allclose(encoder(ROWS), np.concatenate(parts), rtol=1e-5, atol=1e-5)
    save(encoder, tmp_path / "it")
    assert b"somebody" not in (tmp_path / "it").read_bytes()
    export(load(tmp_path / "it"), tmp_path / "again.onnx")
    np.testing.assert_allclose(played(tmp_path / "again.onnx")["latent"], encoder(ROWS), 1e-6)


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (model("y = mine:Relu x"), "can't be run on several rows"),
        (model("y = Log x"), "not finite"),
        (model("y = Relu x", {}, ("x", ("rows", 12))), "expected floats"),
        (model("y = Relu x; z = Tanh x", outputs="y z"), "outputs y, z"),
        (model("y = Relu nothing"), "isn't an ONNX model"),
    ],
)
def test_a_model_that_is_no_encoder_is_refused(made, message, tmp_path):
    (tmp_path / "it.onnx").write_bytes(made.SerializeToString())
    with pytest.raises(InputError, match=message) as refused:
        Encoder.from_onnx(tmp_path / "it.onnx", TASK, None, "mine")
    assert "\n" not in str(refused.value)


def elsewhere(location, weights):
    """A model whose weights are in another file."""
    made = model("y = MatMul x w", {"w": weights})
    (tensor,) = made.graph.initializer
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    return made.SerializeToString()


def test_weights_are_read_from_beside_the_model_alone(tmp_path):
    weights, folder = f32(16, 3), tmp_path / "folder"
    folder.mkdir()
    for path in (tmp_path / "weights", folder / "weights"):
        path.write_bytes(weights.tobytes())
    (folder / "link").symlink_to(tmp_path / "weights")
    (folder / "it.onnx").write_bytes(elsewhere("weights", weights))
    made = Encoder.from_onnx(folder / "it.onnx", TASK, None, "mine")
    np.testing.assert_allclose(made(ROWS), ROWS @ weights, rtol=1e-4, atol=1e-5)
    for location in ("../weights", str(tmp_path / "weights"), "link", "missing"):
        (folder / "it.onnx").write_bytes(elsewhere(location, weights))
        with pytest.raises(InputError, match="isn't an ONNX model that can be read"):
            Encoder.from_onnx(folder / "it.onnx", TASK, None, "mine")


def test_an_encoders_file_reads_no_other_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weights = f32(16, 3)
    (tmp_path / "weights").write_bytes(weights.tobytes())
    onnx.save(model("y = MatMul x w", {"w": weights}), tmp_path / "it.onnx")
    made = Encoder.from_onnx(tmp_path / "it.onnx", TASK, None, "mine")
    forged = np.frombuffer(elsewhere("weights", weights), np.uint8)
    tensors = made.tensors() | {"encoder.0.onnx": forged}
    monkeypatch.setattr(made, "tensors", lambda: tensors)
    save(made, tmp_path / "forged")
    with pytest.raises(InputError, match="the tensor w is in another file"):
        load(tmp_path / "forged")


def test_sizes_of_ones_own_are_an_architecture():
    sizes = get_architecture("64,32")
    assert sizes == get_architecture("64x32")
    assert (sizes.name, sizes.hidden, sizes.output) == ("64x32", (64, 32), "linear")
    used = DAE.of({"latent": 8, "architecture": "64,32"})
    deep = get_architecture("deep")
    assert (used.architecture, used.epochs) == ("64x32", deep.epochs)
    assert name_of(used) == "dae-64x32-8"
    assert read_name("dae-64x32-8")[1] == {"latent": 8, "architecture": "64x32"}
    for wrong in ("64,,32", "0", "64,5000"):
        with pytest.raises(InputError, match="architecture"):
            DAE.of({"latent": 8, "architecture": wrong})
