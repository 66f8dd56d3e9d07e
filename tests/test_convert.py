"""Encoders from torch modules and ONNX models, their activations, and own layer sizes."""

from itertools import pairwise

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from command import jbrep
from onnx import TensorProto, helper, numpy_helper
from torch import nn
from torch.nn import functional

from jbrep.dae import DAE
from jbrep.encoders import ACTIVATIONS, Encoder, Layer, find, load, save
from jbrep.encoders.card import card
from jbrep.encoders.from_onnx import convert
from jbrep.encoders.layers import activate
from jbrep.encoders.onnx import export
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.methods.registry import name_of, read_name
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
    "gelu-tanh": lambda values: functional.gelu(values, approximate="tanh"),
    "silu": functional.silu,
    "elu": functional.elu,
    "leaky-relu": functional.leaky_relu,
    "softplus": functional.softplus,
    "sin": torch.sin,
    "layer-norm": lambda values: functional.layer_norm(values, values.shape[-1:]),
    "avg-l1-norm": lambda values: values / values.abs().mean(-1, keepdim=True),
}


def given(function, rows=ROWS):
    """What a torch function makes of rows."""
    with torch.no_grad():
        return function(torch.from_numpy(rows)).numpy()


def equal(ours, theirs):
    """Whether layers are the same to the bit."""
    return len(ours) == len(theirs) and all(
        one.activation == other.activation
        and np.array_equal(one.weight, other.weight)
        and np.array_equal(one.bias, other.bias)
        for one, other in zip(ours, theirs, strict=True)
    )


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


def layered(activations):
    """An imported encoder with a layer for each activation, from 16 features to 3."""
    sizes = [16, *range(len(activations) + 2, 2, -1)]
    layers = [
        Layer(*(RANDOM.normal(size=shape).astype(np.float32) for shape in ((out, size), (out,))), a)
        for (size, out), a in zip(pairwise(sizes), activations, strict=True)
    ]
    like = find("dae-8", TASK)
    return Encoder(like.header.replace(name="mine"), like.scaler, tuple(layers), ())


def test_an_encoder_with_every_activation_and_no_decoder_as_a_file_and_as_onnx(tmp_path):
    encoder = layered(list(ACTIVATIONS))
    save(encoder, tmp_path / "it")
    again = load(tmp_path / "it")
    assert again.fingerprint == encoder.fingerprint
    assert again.header == encoder.header
    assert not again.can_decode
    np.testing.assert_array_equal(again(ROWS), encoder(ROWS))
    export(again, tmp_path / "it.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    (latent,) = session.run(None, {"observation": ROWS})
    np.testing.assert_allclose(latent, encoder(ROWS), rtol=1e-3, atol=1e-4)
    assert "decoder     none" in card(again, "it", 80)


class Own(nn.Module):
    """Most of what a forward can be made of, with decode."""

    def __init__(self):
        super().__init__()
        self.register_buffer("mean", torch.randn(16))
        self.register_buffer("std", torch.rand(16) + 0.5)
        self.first, self.norm = nn.Linear(16, 8), nn.LayerNorm(8, eps=1e-3)
        self.mix = nn.Parameter(torch.randn(8, 8))
        self.batch, self.last, self.back = nn.BatchNorm1d(8), nn.Linear(8, 3), nn.Linear(3, 16)
        self.drop = nn.Dropout(0.5)

    def encode(self, x):
        x = functional.gelu(self.first((x - self.mean) / (self.std + 1e-8)))
        x = self.norm(x.float().flatten(1)) @ self.mix.T
        x = self.drop(x * torch.sigmoid(x)).view(-1, 8)
        x = functional.dropout(
            self.batch(0.5 * x * (1 + torch.erf(x / 2**0.5))), 0.5, self.training
        )
        x = functional.softplus(functional.linear(x, self.mix[:4]), beta=3)
        x = 1 - functional.layer_norm(x, (4,), eps=1e-4)
        x = (1 / (1 + torch.exp(-x @ self.mix[:4, :8]))).tanh().neg()
        return torch.log(1 + torch.exp(self.last(functional.elu(x))))

    def decode(self, z):
        return self.back(z.relu()) * self.std + self.mean


@pytest.fixture(scope="module")
def own():
    torch.manual_seed(1)
    module = Own()
    module.batch.running_mean.normal_()
    module.batch.running_var.uniform_(0.5, 2)
    return module


def test_a_torch_module_becomes_an_encoder_and_stays_as_it_is(own, tmp_path):
    before = {name: value.clone() for name, value in own.state_dict().items()}
    encoder = Encoder.from_torch(own, "face_direction", name="mine")
    assert own.training
    assert all(torch.equal(value, before[name]) for name, value in own.state_dict().items())
    own.eval()
    latent = given(own.encode)
    own.train()
    np.testing.assert_allclose(encoder(ROWS), latent, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        encoder.decode(latent), given(own.decode, latent), rtol=1e-5, atol=1e-5
    )
    assert (encoder.kind, encoder.name, encoder.task) == ("imported", "mine", TASK)
    save(encoder, tmp_path / "it")
    assert load(tmp_path / "it").fingerprint == encoder.fingerprint


def test_affine_maps_in_a_row_are_one_layer_and_a_decoder_may_be_a_module_of_its_own():
    parts = nn.Linear(16, 9), nn.Linear(9, 5, bias=False), nn.Tanh(), nn.Identity()
    encoder = Encoder.from_torch(nn.Sequential(*parts).double(), TASK, decoder=nn.Linear(5, 16))
    assert [(layer.weight.shape, layer.activation) for layer in encoder.encoder] == [
        ((5, 16), "tanh")
    ]
    assert encoder.can_decode
    short = nn.Linear(16, 20).bfloat16()  # to a larger latent
    assert not Encoder.from_torch(short, TASK).can_decode
    with pytest.raises(InputError, match=r"Linear: .* it takes 4 numbers, but gets 5"):
        Encoder.from_torch(nn.Sequential(*parts), TASK, decoder=nn.Linear(4, 16))
    with pytest.raises(InputError, match="the last layer has 15 units, expected 16"):
        Encoder.from_torch(nn.Sequential(*parts), TASK, decoder=nn.Linear(5, 15))


class Wrong(nn.Module):
    def __init__(self, forward):
        super().__init__()
        self.first, self.does = nn.Linear(16, 16), forward
        self.mish, self.batch = nn.Mish(), nn.BatchNorm1d(16, track_running_stats=False)

    def forward(self, x):
        return self.does(self, x)


@pytest.mark.parametrize(
    ("forward", "message"),
    [
        (lambda m, x: m.mish(x), r"Mish \(mish\) can't be converted: an encoder has no such layer"),
        (lambda m, x: functional.mish(x), "the function mish can't be converted"),
        (lambda m, x: x.softmax(1), "the method softmax can't be converted"),
        (lambda m, x: x + m.first(x), "the function add .* stands in a branch"),
        (lambda m, x: x if x.sum() > 0 else m.first(x), "control flow"),
        (lambda m, x: x * functional.softplus(x).tanh(), "softplus, .* tanh, .* no activation"),
        (lambda m, x: m.batch(x), "no running statistics"),
        (lambda m, x: functional.elu(x, 0.5), "its alpha is 0.5: only 1"),
        (lambda m, x: functional.leaky_relu(x, 0.2), "its slope is 0.2: only 0.01"),
        (lambda m, x: functional.dropout(x), "on in evaluation, too"),
        (lambda m, x: torch.add(x, m.first.bias, alpha=2), "not with these arguments"),
        (lambda m, x: x.clamp_(0, 1) * 0 + x, "clamp"),
        (lambda m, x: (m.first(x).relu_(), x.sub_(1), m.first(x))[2], "changing a value in place"),
        (lambda m, x: (m.first(x), x), "returns tuple, expected one tensor"),
        (lambda m, x: m.first(x) / 0, "numbers that are not finite"),
        (lambda m, x: m.first.weight, "doesn't depend on the input"),
        (lambda m, x: x, "nothing to convert"),
        (lambda m, x: x @ torch.zeros(12, 3), "takes 12 numbers, but gets 16"),
        (lambda m, x: x.numpy(), "Wrong"),
    ],
)
def test_a_module_that_is_no_chain_is_refused_by_name(forward, message):
    with pytest.raises(InputError, match=message):
        Encoder.from_torch(Wrong(forward), TASK)


def test_what_is_no_module_or_has_hooks_or_a_bad_name_is_refused():
    hooked = nn.Linear(16, 3)
    hooked.register_forward_hook(lambda module, given, result: result * 2)
    with pytest.raises(InputError, match="the hooks of Linear"):
        Encoder.from_torch(hooked, TASK)
    with pytest.raises(InputError, match="function isn't a torch module"):
        Encoder.from_torch(lambda x: x, TASK)
    with pytest.raises(InputError, match="name is 'My net'"):
        Encoder.from_torch(nn.Linear(16, 3), TASK, name="My net")


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(2)
    return nn.Sequential(
        *(nn.Linear(16, 12), nn.GELU(), nn.LayerNorm(12), nn.Linear(12, 8), nn.SiLU()),
        *(nn.BatchNorm1d(8), nn.Linear(8, 6), nn.GELU("tanh"), nn.Dropout(), nn.Linear(6, 6)),
        *(nn.Softplus(), nn.Linear(6, 5), nn.ELU(), nn.Linear(5, 5), nn.LeakyReLU()),
        *(nn.Linear(5, 5), nn.Sigmoid()),
        *(nn.Linear(5, 4), nn.ReLU(), nn.Linear(4, 3), nn.Tanh()),
    ).eval()


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
@pytest.mark.parametrize(
    "how", [{"dynamo": False, "opset_version": 17}, {"dynamo": False}, {"dynamo": True}], ids=str
)
def test_a_module_and_its_export_have_the_same_layers(network, how, tmp_path):
    path = tmp_path / "it.onnx"
    torch.onnx.export(network, (torch.zeros(2, 16),), str(path), verbose=False, **how)
    imported = convert(path, TASK, None, "mine")
    assert equal(imported.encoder, Encoder.from_torch(network, TASK).encoder)
    np.testing.assert_allclose(imported(ROWS), given(network), rtol=1e-5, atol=1e-5)


def test_what_jbrep_exports_comes_back_with_its_decoder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    like = find("dae-8", TASK)
    jbrep("encoder", "export", "dae-8", "--task", "face_direction", "--out", "it.onnx")
    command = ("encoder", "import", "it.onnx", "--task", "face_direction", "--out")
    told = jbrep(*command, "mine.safetensors").stdout
    assert told.startswith("mine\n")
    assert "kind        imported" in told
    mine = find("mine.safetensors", TASK)
    np.testing.assert_allclose(mine(ROWS), like(ROWS), rtol=1e-5, atol=1e-6)
    latent = like(ROWS)
    np.testing.assert_allclose(mine.decode(latent), like.decode(latent), rtol=1e-5, atol=1e-5)
    for out, message in (
        ("mine.safetensors", "exists already"),
        ("Mine", "must be lower-case"),
    ):
        refused = jbrep(*command, out)
        assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
        assert message in refused.stderr
    again = jbrep(*command, "Mine", "--name", "other", "--decoder", "it.onnx")
    assert "it.onnx: its input observation is (rows, 16), expected (rows, 8)" in again.stderr


def node(line, **attributes):
    """A node from a line such as `c = Add a b`."""
    outputs, operation, *inputs = line.replace(" =", "").split()
    domain, _, name = operation.rpartition(":")
    return helper.make_node(name, inputs, outputs.split(","), domain=domain, **attributes)


def model(nodes, constants=None, inputs=("x", ("rows", 16)), outputs="y"):
    """An ONNX model of nodes, or of lines `c = Add a b; d = Relu c`."""
    if isinstance(nodes, str):
        nodes = [node(line) for line in nodes.split("; ")]
    graph = helper.make_graph(
        nodes,
        "graph",
        [helper.make_tensor_value_info(inputs[0], TensorProto.FLOAT, inputs[1])],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, (None, None))
            for name in outputs.split()
        ],
        [numpy_helper.from_array(np.asarray(v), name) for name, v in (constants or {}).items()],
    )
    opsets = [helper.make_opsetid("", 20), helper.make_opsetid("mine", 1)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=9)


def f32(*shape):
    return RANDOM.normal(size=shape).astype(np.float32)


def single(value):
    return np.array(value, np.float32)


DEEP = "; ".join(f"y{i + 1} = Relu y{i}" for i in range(9))
CHAINS = {
    "gemm": ([node("y = Gemm x w b", alpha=0.5, beta=2.0)], {"w": f32(16, 3), "b": single(2)}),
    "transposed": (
        [node("t = Transpose w", perm=[1, 0]), node("m = MatMul x t"), node("y = Sub m b")],
        {"w": f32(3, 16), "b": f32(1, 3)},
    ),
    "arithmetic": (
        "a = Sub c x; d = Div a v; e = Mul s d; y = Neg e",
        {"c": f32(16), "v": f32(16), "s": single([0.5])},
    ),
    "constants": (
        [
            *(node("c = Constant", value_float=0.25), node("d = Cast c", to=1)),
            *(node("a = Mul x d"), node("b = Identity a"), node("f = Flatten b")),
            *(node("r = Reshape f n"), node("e = Dropout r"), node("y = Softplus e")),
        ],
        {"n": np.array([-1, 16])},
    ),
    "norms": (
        [
            node("a = BatchNormalization x s b m v", epsilon=1e-3),
            node("y = LayerNormalization a s b", epsilon=1e-2),
        ],
        {"s": f32(16), "b": f32(16), "m": f32(16), "v": np.square(f32(16))},
    ),
    "gelu": ([node("a = Gelu x"), node("y = Gelu a", approximate="tanh")],),
    "gelu in parts": (
        "l = Mul x h; d = Div x r; e = Erf d; p = Add o e; y = Mul l p",
        {"h": single(0.5), "r": single(2**0.5), "o": single(1)},
    ),
    "swish in parts": ("s = Sigmoid x; a = Mul x s; y = Elu a",),
    "softplus in parts": (
        "e = Exp x; p = Add e o; l = Log p; g = Greater x t; y = Where g x l",
        {"o": single(1), "t": single(20)},
    ),
    "whole constants": (
        [node("i = Cast w", to=7), node("f = Cast i", to=1), node("y = MatMul x f")],
        {"w": 3 * f32(16, 4)},
    ),
    "one row": ("a = Reshape x n; y = Relu a", {"n": np.array([1, -1])}, ("x", (1, 16))),
    "float64": ([node("a = Cast x", to=11), node("y = MatMul a w")], {"w": np.eye(16) * 2}),
}


@pytest.mark.parametrize("name", CHAINS)
def test_a_model_gives_what_onnxruntime_gives(name, tmp_path):
    made = model(*CHAINS[name])
    if name == "float64":
        made.graph.output[0].type.tensor_type.elem_type = TensorProto.DOUBLE
    onnx.save(made, tmp_path / "it.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    parts = np.split(ROWS, len(ROWS) if name == "one row" else 1)
    expected = np.concatenate([session.run(None, {"x": part})[0] for part in parts])
    imported = convert(tmp_path / "it.onnx", TASK, None, "mine")
    np.testing.assert_allclose(imported(ROWS), expected, rtol=1e-5, atol=1e-5)
    assert len(imported.encoder) <= 3


def test_a_decoder_of_its_own(tmp_path):
    onnx.save(model("y = MatMul x w", {"w": f32(16, 3)}), tmp_path / "into.onnx")
    back = model("y = MatMul x w", {"w": f32(3, 16)}, ("x", (1, 3)))
    onnx.save(back, tmp_path / "back.onnx")
    encoder = convert(tmp_path / "into.onnx", TASK, tmp_path / "back.onnx", "mine")
    assert encoder.can_decode
    assert encoder.decode(encoder(ROWS)).shape == ROWS.shape


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("y = Selu x",), r"Selu \(y\) can't be converted: an encoder has no such layer"),
        (("y = mine:Relu x",), r"mine.Relu \(y\) .* no operation of ONNX itself"),
        (("y = MatMul x w", {"w": f32(12, 3)}), "takes 12 numbers, but gets 16"),
        (("y = MatMul w x", {"w": f32(3, 16)}), "its first input alone may depend"),
        (("y = MatMul x w", {"w": f32(2, 16, 3)}), r"its weight has shape \(3, 16, 2\)"),
        (("y = MatMul x w", {"w": np.full((16, 3), np.nan, np.float32)}), "not finite"),
        (("y = MatMul x w", {"w": np.ones((16, 3), np.float16)}), "w is of float16"),
        (("y = Add x c", {"c": f32(2, 16)}), r"constant of shape \(2, 16\)"),
        (("y = Mul x x",), r"Mul \(y\) can't be converted: no activation"),
        (("a = MatMul x w; y = Add x a", {"w": f32(16, 16)}), "in a branch"),
        (([node("y = Elu x", alpha=0.5)],), "its alpha is 0.5"),
        (([node("y = Flatten x", axis=0)],), "its axis is 0, expected 1"),
        (("y = Reshape x n", {"n": np.array([-1, 4, 4])}), r"makes the shape \(-1, 4, 4\)"),
        (("y = Reshape x n", {"n": np.array([1, -1])}), "it makes 1 row of any number, expected"),
        (("a = MatMul x w; y = Squeeze a", {"w": f32(16, 1)}), "it removes a dimension"),
        (("y = Add x c", {"c": f32(1, 1, 1)}), r"of shape \(1, 1, 1\), expected at most two"),
        (("p = Pow x c; y = Mul p s", {"c": single(3), "s": single(1e-12)}), "no activation"),
        (([node("y = Cast x", to=7)],), "other numbers than float32"),
        (("y = Relu x", {}, ("x", ("rows", 12))), r"is \(rows, 12\), expected \(rows, 16\)"),
        (("y = Relu x", {}, ("x", (16,))), r"is \(16\), expected \(rows, 16\)"),
        (("y = Relu x; z = Tanh x", {}, ("x", (1, 16)), "y z"), "has the outputs y, z"),
        (([node("y = Constant", value_float=1.0)],), "doesn't depend on the input"),
        (
            (
                *("latent = Relu x; reconstruction = Add x latent", {}, ("x", (1, 16))),
                "latent reconstruction",
            ),
            "reads x, from before the latent",
        ),
        (("a = Relu x; y = Relu nothing",), "an ONNX model that can be read"),
        (("y = Relu x; y = Relu x",), "an ONNX model that can be read"),
        (([node(f"y{i} = Relu x") for i in range(1001)],), "more than 1000 nodes"),
        (
            (f"y0 = MatMul x w; {DEEP}", {"w": f32(16, 4096)}, ("x", (1, 16)), "y9"),
            "its layers have more than 67,108,864 numbers",
        ),
    ],
)
def test_a_model_that_is_no_chain_is_refused_by_name(given, message, tmp_path):
    (tmp_path / "it.onnx").write_bytes(model(*given).SerializeToString())
    with pytest.raises(InputError, match=message) as refused:
        convert(tmp_path / "it.onnx", TASK, None, "mine")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("operator", ["Mul", "MatMul", "Transpose"])
def test_a_model_whose_nodes_make_many_numbers_of_few_is_refused(operator, tmp_path, monkeypatch):
    monkeypatch.setattr("jbrep.encoders.from_onnx._MOST_KEPT", 20_000)
    weights = {"W": f32(16, 100), "V": f32(100, 100), "s": np.float32(2)}
    of = {"Mul": "h s", "MatMul": "h V", "Transpose": "V"}[operator]
    nodes = ["h = MatMul x W", *(f"y{i} = {operator} {of}" for i in range(30))]
    path = tmp_path / "it.onnx"
    made = model("; ".join(nodes), weights, outputs="y29")
    path.write_bytes(made.SerializeToString())
    with pytest.raises(InputError, match="the nodes before it make more than 20,000 numbers"):
        convert(path, TASK, None, "mine")


@pytest.mark.parametrize("kind", ["none", "text", "folder"])
def test_what_is_no_model_is_refused(kind, tmp_path):
    path = tmp_path / "it.onnx"
    if kind == "text":
        path.write_text("PK hello")
    elif kind == "folder":
        path.mkdir()
    with pytest.raises(InputError):
        convert(path, TASK, None, "mine")


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ({"location": "weights"}, None),
        ({"location": "../weights"}, "only a file beside the model is read"),
        ({"location": "/etc/passwd"}, "only a file beside the model is read"),
        ({"location": ".."}, "only a file beside the model is read"),
        ({"location": "missing"}, "no file"),
        ({"location": "weights", "offset": "-8"}, "doesn't fit"),
        ({"location": "weights", "length": "9999"}, "doesn't fit"),
        ({"location": "weights", "length": "8"}, "an ONNX model that can be read"),
        ({"location": "weights", "offset": "x"}, "an ONNX model that can be read"),
    ],
    ids=str,
)
def test_weights_are_read_from_a_regular_file_beside_the_model_alone(where, message, tmp_path):
    weights = f32(16, 3)
    folder = tmp_path / "folder"
    folder.mkdir()
    for path in (tmp_path / "weights", folder / "weights"):
        path.write_bytes(weights.tobytes())
    made = model("y = MatMul x w", {"w": weights})
    (tensor,) = made.graph.initializer
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in where.items():
        tensor.external_data.add(key=key, value=value)
    (folder / "it.onnx").write_bytes(made.SerializeToString())
    if message:
        with pytest.raises(InputError, match=message):
            convert(folder / "it.onnx", TASK, None, "mine")
    else:
        imported = convert(folder / "it.onnx", TASK, None, "mine")
        np.testing.assert_array_equal(imported.encoder[0].weight, weights.T)


def test_files_beside_a_model_count_whole_towards_its_size(tmp_path, monkeypatch):
    weights, bias = f32(16, 3), f32(3)
    made = model("t = MatMul x w; y = Add t b", {"w": weights, "b": bias})
    for tensor, numbers in zip(made.graph.initializer, (weights, bias), strict=True):
        (tmp_path / tensor.name).write_bytes(numbers.tobytes() + bytes(200))
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=tensor.name)
        tensor.external_data.add(key="length", value=str(numbers.nbytes))
    path = tmp_path / "it.onnx"
    path.write_bytes(made.SerializeToString())
    assert convert(path, TASK, None, "mine").encoder
    monkeypatch.setattr("jbrep.encoders.from_onnx._MAX_BYTES", 500)
    with pytest.raises(InputError, match="the model's other files have more than 500 bytes"):
        convert(path, TASK, None, "mine")


def test_sizes_of_ones_own_are_an_architecture(tmp_path):
    sizes = get_architecture("64,32")
    assert sizes == get_architecture("64x32")
    assert (sizes.name, sizes.hidden, sizes.output) == ("64x32", (64, 32), "linear")
    used = DAE.of({"latent": 8, "architecture": "64,32"})
    deep = get_architecture("deep")
    assert (used.architecture, used.epochs) == ("64x32", deep.epochs)
    assert name_of(used) == "dae-64x32-8"
    assert read_name("dae-64x32-8").given == {"latent": 8, "architecture": "64x32"}
    data = ("--data", "data/sample/face_direction", "--out", tmp_path)
    command = ("train-encoder", "--kind", "untrained", "--latent", "8", *data, "--architecture")
    jbrep(*command, "64,32")
    made = load(tmp_path / "untrained-64x32-8.safetensors")
    assert [len(layer.bias) for layer in (*made.encoder, *made.decoder)] == [64, 32, 8, 32, 64, 16]
    assert made.header.training["architecture"] == "64x32"
    for wrong, message in {
        "64,,32": "'64,,32': choose one of paper, deep, linear, sizes such as 64x64",
        "0": "unknown architecture '0'",
        "64,5000": "architecture 64,5000 has 5000 units: the limit is 4096",
        "2000,2000": "architecture 2000x2000 has weights of 32,384,000 bytes with 16 features",
    }.items():
        refused = jbrep(*command, wrong)
        assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
        assert message in refused.stderr
