"""Networks of n agents as one: every weight has a leading axis, with an entry for each agent.

Observations of different sizes are padded with zeros. The gradient of a weight on a zero is zero,
and Adam leaves it at zero.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn import Linear, Module, functional
from torch.optim import Adam
from torch.optim.adam import adam
from torch.utils._pytree import tree_leaves

from jbrep.rl.settings import CPU, FLOAT32
from jbrep.training.trainer import allocate_adam_state

_MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam
_ALIGNED = 64  # [bytes]; where torch puts what it makes


class Layer(NamedTuple):
    """An affine layer of n networks."""

    weight: Tensor  # (n, in, out)
    bias: Tensor  # (n, 1, out)


Network = list[Layer]


class Activation(NamedTuple):
    """A function between layers, and its gradient."""

    function: Callable[[Tensor], Tensor]  # it may overwrite what it is given
    gradient: Callable[[Tensor, Tensor, Tensor], Tensor]  # from that of its output, input, output


_aten = torch.ops.aten
_ACTIVATIONS: dict[type[Module], Activation] = {
    nn.ReLU: Activation(torch.relu_, lambda g, _, y: _aten.threshold_backward(g, y, 0)),
    nn.Tanh: Activation(torch.tanh, lambda g, _, y: _aten.tanh_backward(g, y)),
    nn.ELU: Activation(functional.elu, lambda g, x, _: _aten.elu_backward(g, 1, 1, 1, False, x)),
    nn.GELU: Activation(functional.gelu, lambda g, x, _: _aten.gelu_backward(g, x)),
    nn.SiLU: Activation(functional.silu, lambda g, x, _: _aten.silu_backward(g, x)),
    nn.LeakyReLU: Activation(
        functional.leaky_relu, lambda g, x, _: _aten.leaky_relu_backward(g, x, 0.01, False)
    ),
}


class MLP(NamedTuple):
    """How networks compute."""

    activation: Activation  # of hidden layers
    cast: Callable[[Tensor], Tensor]  # each factor of a product
    multiply: Callable[[Tensor, Tensor], Tensor]  # (n, b, in) and (n, in, out), both cast
    together: bool  # whether all networks compute at once

    def __call__(self, network: Network, inputs: Tensor) -> Tensor:
        """The outputs (n, b, out) of networks on inputs (n, b, in)."""
        outputs: Tensor = _StackedMLP.apply(
            inputs, self, *(each for layer in network for each in layer)
        )
        return outputs


class _Done(NamedTuple):
    """What a layer's gradient is made from; both factors as they were cast."""

    inputs: Tensor
    weight: Tensor
    before: Tensor  # the activation, if there is one
    after: Tensor


class _StackedMLP(Function):
    """Forward and backward of stacked MLPs, some networks at a time.

    So what a layer leaves is still in the processor's cache when the next one takes it.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, mlp: MLP, *weights: Tensor) -> Tensor:
        ctx.mlp, ctx.parts = mlp, []
        parts = 1 if mlp.together else len(inputs)
        every = (each.chunk(parts) for each in (inputs, *weights))
        for values, *own in zip(*every, strict=True):
            values = _aligned(values)
            done, last = list[_Done](), len(own) - 2
            for i in range(0, len(own), 2):
                factors = mlp.cast(values), mlp.cast(own[i])
                before = values = mlp.multiply(*factors).add_(own[i + 1])
                if i < last:
                    values = mlp.activation.function(before)
                done.append(_Done(*factors, before, values))
            ctx.parts.append(done)
        return torch.cat([done[-1].after for done in ctx.parts])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        mlp, (of_inputs, _, of_weights, *_) = ctx.mlp, ctx.needs_input_grad
        every = []
        for own, done in zip(gradient.chunk(len(ctx.parts)), ctx.parts, strict=True):
            own, gradients = _aligned(own), list[Tensor]()
            for i, layer in reversed([*enumerate(done)]):
                if layer is not done[-1]:
                    own = mlp.activation.gradient(own, layer.before, layer.after)
                factor = mlp.cast(own)
                if of_weights:
                    of_weight = mlp.multiply(layer.inputs.mT, factor)
                    gradients += [own.sum(1, keepdim=True), of_weight]
                if i > 0 or of_inputs:
                    own = mlp.multiply(factor, layer.weight.mT)
            every.append([own, *reversed(gradients)])
        of_input, *of_each = map(torch.cat, zip(*every, strict=True))
        nothing = [None] * (len(ctx.needs_input_grad) - 2)
        return of_input if of_inputs else None, None, *(of_each or nothing)


def _aligned(values: Tensor) -> Tensor:
    """Values where a product sums them as if they were alone: elsewhere it may in another order."""
    return values if values.data_ptr() % _ALIGNED == 0 else values.clone()


def make_mlp(activation: Module, precision: str, device: torch.device) -> MLP:
    """How networks compute with a precision of products, on a device.

    A processor computes each network by itself: it sums a product of a batch differently if that
    has one member, or many.
    """
    function = _ACTIVATIONS[type(activation)]
    on_gpu = device.type == "cuda"
    if precision == FLOAT32:
        return MLP(function, lambda values: values, torch.bmm, on_gpu)
    if on_gpu or torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return MLP(function, Tensor.bfloat16, lambda a, b: torch.bmm(a, b).float(), on_gpu)
    return MLP(function, _rounded, lambda a, b: _rounded(torch.bmm(a, b)), on_gpu)


def _rounded(values: Tensor) -> Tensor:
    """To bfloat16, kept as they were: products of such factors are exact in float32."""
    return values.bfloat16().to(values.dtype)


class StackedAdam(Adam):
    """Adam of stacked weights that takes each network's by themselves.

    Its fused kernel rounds the last numbers of a tensor, which don't fill a vector of the
    processor, otherwise than those before: which these are may not depend on how many networks
    there are. The state has a step for each.
    """

    def __init__(self, weights: Sequence[Tensor], **settings: Any):
        super().__init__(weights, **settings)
        allocate_adam_state(self)
        for weight, state in self.state.items():
            state["step"] = state["step"].repeat(len(weight))

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]  # no closures
        """Take a step of the weights that have gradients."""
        (group,) = self.param_groups
        weights = [weight for weight in group["params"] if weight.grad is not None]
        states = [self.state[weight] for weight in weights]
        mean, square, step = (
            _unbound(state[name] for state in states) for name in (*_MOMENTS, "step")
        )
        gradients = _unbound(weight.grad for weight in weights if weight.grad is not None)
        beta1, beta2 = group["betas"]
        names = "amsgrad", "lr", "weight_decay", "eps", "maximize", "fused"
        settings = {name: group[name] for name in names}
        parts = _unbound(weights), gradients, mean, square
        adam(*parts, [], step, beta1=beta1, beta2=beta2, **settings)


def _unbound(stacked: Iterable[Tensor]) -> list[Tensor]:
    """Each network's part of each tensor."""
    return list(chain.from_iterable(each.unbind() for each in stacked))


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
        precision: of matrix multiplications.
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
        optimizer = StackedAdam(tree_leaves(weights), **own[0].defaults)
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
                    yield moments["step"], place[0], own["step"]
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
