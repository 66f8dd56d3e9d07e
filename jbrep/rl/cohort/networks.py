"""Networks of n agents as one: every weight has a leading axis, with an entry for each agent.

Observations of different sizes are padded with zeros. The gradient of a weight on a zero is zero,
and Adam leaves it at zero.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn import Linear, Module, ReLU
from torch.optim import Adam
from torch.utils._pytree import tree_leaves

from jbrep.rl.settings import CPU, FLOAT32
from jbrep.training.trainer import allocate_adam_state

_MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam


class Layer(NamedTuple):
    """An affine layer of n networks."""

    weight: Tensor  # (n, in, out)
    bias: Tensor  # (n, 1, out)


Network = list[Layer]


class MLP(NamedTuple):
    """How networks compute."""

    activation: Callable[[Tensor], Tensor]  # of hidden layers; it may overwrite what it is given
    cast: Callable[[Tensor], Tensor]  # each factor, once, however many products it is in
    multiply: Callable[[Tensor, Tensor], Tensor]  # (n, b, in) and (n, in, out), both cast

    def __call__(self, network: Network, inputs: Tensor) -> Tensor:
        """The outputs (n, b, out) of networks on inputs (n, b, in)."""
        *hidden, last = network
        for layer in hidden:
            inputs = self.activation(_Affine.apply(inputs, *layer, self))
        outputs: Tensor = _Affine.apply(inputs, *last, self)
        return outputs


class _Affine(Function):
    """Affine layers, and their gradients, by the products of an MLP."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, mlp: MLP) -> Tensor:
        inputs, weight = map(mlp.cast, (inputs, weight))
        ctx.save_for_backward(inputs, weight)
        ctx.mlp = mlp
        return mlp.multiply(inputs, weight).add_(bias)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        inputs, weight = ctx.saved_tensors
        of_inputs, of_layer, *_ = ctx.needs_input_grad
        factor, multiply = ctx.mlp.cast(gradient), ctx.mlp.multiply
        return (
            multiply(factor, weight.mT) if of_inputs else None,
            multiply(inputs.mT, factor) if of_layer else None,
            gradient.sum(1, keepdim=True) if of_layer else None,
            None,
        )


def make_mlp(activation: Module, precision: str, device: torch.device) -> MLP:
    """How networks compute with a precision of products, on a device."""
    function = torch.relu_ if isinstance(activation, ReLU) else activation
    multiply = torch.bmm if device.type == "cuda" else _one_by_one
    if precision == FLOAT32:
        return MLP(function, lambda values: values, multiply)
    if device.type == "cuda" or torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return MLP(function, Tensor.bfloat16, lambda a, b: multiply(a, b).float())
    return MLP(function, _rounded, lambda a, b: _rounded(multiply(a, b)))


def _rounded(values: Tensor) -> Tensor:
    """To bfloat16, kept as they were: products of such factors are exact in float32."""
    return values.bfloat16().to(values.dtype)


def _one_by_one(left: Tensor, right: Tensor) -> Tensor:
    """Products of matrices, each by itself: its bits don't depend on how many there are.

    A processor sums a product of a batch differently if it has one member, or many.
    """
    products = left.new_empty(len(left), left.shape[1], right.shape[2])
    each = zip(left.unbind(), right.unbind(), products.unbind(), strict=True)
    for a, b, product in each:
        torch.mm(a, b, out=product)
    return products


Modules = Iterable[Module | list[Linear]]  # of an agent's network; several can be one layer
_Part = tuple[Tensor, tuple[int, list[int], slice]]  # an agent's parameter; where a stack has it


class Stack:
    """Weights and optimisers of n agents as one: read from them, and written back.

    What its methods make is zero until it is read. They take functions that find the same of each
    agent.

    Args:
        agents: stable-baselines3's, of one algorithm and with the same settings; with the state of
            their optimisers allocated.
        size: to which observations are padded.
        precision: of products of matrices.
        device: of the stack.

    Attributes:
        agents: n.
        mlp: how their networks compute.
    """

    def __init__(
        self, agents: Sequence[Any], size: int, precision: str = FLOAT32, device: str = CPU
    ):
        self.agents, self._size, self._device = agents, size, torch.device(device)
        self.mlp = make_mlp(agents[0].policy.activation_fn(), precision, self._device)
        self._parts: dict[Tensor, list[_Part]] = {}
        self._optimizers: list[tuple[Adam, dict[Tensor, dict[str, Tensor]]]] = []

    def networks(self, find: Callable[[Any], Iterable[Modules]]) -> list[Network]:
        """Networks whose first inputs are observations."""
        networks, nothing = [], [0] * len(self.agents)
        sizes = [agent.observation_space.shape[0] for agent in self.agents]
        for each in zip(*map(find, self.agents), strict=True):
            first, *others = zip(*map(_layers, each), strict=True)
            layers = [self._layer(layer, nothing, 0) for layer in others]
            networks.append([self._layer(first, sizes, self._size), *layers])
        return networks

    def numbers(self, find: Callable[[Any], Tensor]) -> Tensor:
        """One number of each agent, (n, 1, 1)."""
        own = enumerate(map(find, self.agents))
        return self._zeros(1, 1, [(each, (i, [0], slice(1))) for i, each in own])

    def adam(self, weights: Any, find: Callable[[Any], Adam]) -> Adam:
        """Adam of stacked weights."""
        own = [find(agent) for agent in self.agents]
        optimizer = Adam(tree_leaves(weights), **own[0].defaults)
        allocate_adam_state(optimizer)
        state = {weight: moments for each in own for weight, moments in each.state.items()}
        self._optimizers.append((optimizer, state))
        return optimizer

    def set_learning_rate(self, rate: float) -> None:
        """Let all optimisers go on with it."""
        for optimizer, _ in self._optimizers:
            optimizer.param_groups[0]["lr"] = rate

    def read_from_agents(self) -> None:
        """Take the agents' weights and moments."""
        for stacked, place, own in self._places():
            stacked[place] = own.to(self._device)

    def write_to_agents(self) -> None:
        """Write weights and moments into the agents."""
        for stacked, place, own in self._places():
            own.copy_(stacked[place])

    def _places(self) -> Iterator[tuple[Tensor, Any, Tensor]]:
        """All that the stack has of agents: its tensor, a place in that, and the agent's own."""
        for stacked, parts in self._parts.items():
            for parameter, place in parts:
                yield stacked, place, _matrix(parameter)
        for optimizer, state in self._optimizers:
            for weight, moments in optimizer.state.items():
                for parameter, place in self._parts[weight]:
                    own = state[parameter]
                    yield moments["step"], (), own["step"]
                    for name in _MOMENTS:
                        yield moments[name], place, _matrix(own[name])

    def _layer(self, modules: Sequence[list[Linear]], sizes: Sequence[int], padded: int) -> Layer:
        """A layer of all agents, whose first inputs, `sizes` of each, are padded to so many."""
        weights, biases = list[_Part](), list[_Part]()
        inputs = modules[0][0].in_features - sizes[0] + padded
        for agent, (own, size) in enumerate(zip(modules, sizes, strict=True)):
            rows, outputs = [*range(size), *range(padded, inputs)], 0
            for module in own:
                columns = slice(outputs, outputs + module.out_features)
                outputs += module.out_features
                weights.append((module.weight, (agent, rows, columns)))
                biases.append((module.bias, (agent, [0], columns)))
        return Layer(self._zeros(inputs, outputs, weights), self._zeros(1, outputs, biases))

    def _zeros(self, rows: int, columns: int, parts: list[_Part]) -> Tensor:
        """A tensor that is to have these parts, (n, rows, columns)."""
        shape = len(self.agents), rows, columns
        stacked = torch.zeros(shape, dtype=parts[0][0].dtype, device=self._device)
        self._parts[stacked] = parts
        return stacked


def _layers(modules: Modules) -> list[list[Linear]]:
    """The linear layers among a network's modules."""
    return [[m] if isinstance(m, Linear) else m for m in modules if isinstance(m, Linear | list)]


def _matrix(values: Tensor) -> Tensor:
    """An agent's parameter, or a moment of it, as a stack has it: (in, out), or (1, out)."""
    values = values.detach()
    return values.T if values.ndim == 2 else values.view(1, -1)
