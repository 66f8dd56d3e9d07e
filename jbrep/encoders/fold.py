"""Networks given as operations on named values, brought into a chain of dense layers."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.layers import ACTIVATIONS, EPSILON, LAYER_NORM, MAX_UNITS, WHOLE, Layer
from jbrep.errors import InputError

Array = NDArray[np.float64]

_HALF = np.concatenate((np.linspace(0, 8, 65)[1:], np.geomspace(8, 100, 40)))
_PROBES: Array = np.concatenate((-_HALF[::-1], [0], _HALF))  # of functions of one number
_PRECISION = 1e-6  # to which a function must be an activation
_MOST_NAMED = 8  # operations in a message


class Chain:
    """Layers from affine maps, of which any number in a row become one, and activations.

    Affine maps are multiplied in float64; the layers are float32.

    Args:
        size: numbers that the chain takes.

    Attributes:
        width: numbers that it gives so far.
    """

    def __init__(self, size: int):
        self.width = size
        self._layers: list[Layer] = []
        self._map: tuple[Array, Array] | None = None  # weight, bias after the last activation

    def affine(self, weight: Any, bias: Any = 0) -> None:
        """Add values @ weight.T + bias.

        Args:
            weight: (out, in).
            bias: (out,), or one number.

        Raises:
            InputError: other shapes.
        """
        weight, bias = np.asarray(weight, np.float64), np.asarray(bias, np.float64)
        if weight.ndim != 2 or not weight.size:
            raise InputError(f"its weight has shape {weight.shape}, expected (out, in)")
        outputs, inputs = weight.shape
        if inputs != self.width:
            raise InputError(f"it takes {inputs} numbers, but gets {self.width}")
        if outputs > MAX_UNITS:
            raise InputError(f"it has {outputs} units: the limit is {MAX_UNITS}")
        bias = _row(bias, outputs)
        if self._map:
            before, shift = self._map
            self._map = weight @ before, weight @ shift + bias
        else:
            self._map = weight, bias
        self.width = outputs

    def scale(self, factor: Any, shift: Any = 0) -> None:
        """Add values * factor + shift, each (width,) or one number.

        Raises:
            InputError: other shapes.
        """
        factor, shift = (_row(np.asarray(v, np.float64), self.width) for v in (factor, shift))
        weight, bias = self._map or (np.eye(self.width), np.zeros(self.width))
        self._map = weight * factor[:, None], bias * factor + shift

    def activate(self, name: str) -> None:
        """Add an activation, which ends a layer."""
        weight, bias = self._map or (np.eye(self.width), np.zeros(self.width))
        single = np.asarray(weight, np.float32, order="C"), np.float32(bias + 0.0)  # no -0.0
        self._layers.append(Layer(*single, name))
        self._map = None

    def layer_norm(self, epsilon: float) -> None:
        """Add a layer norm without weights of its own.

        With another epsilon than an encoder's it is the same one of values that are scaled: both
        then divide by the same number.

        Raises:
            InputError: an epsilon that is no positive number.
        """
        if not 0 < epsilon < math.inf:
            raise InputError(f"its epsilon is {epsilon}: it must be positive")
        if epsilon != EPSILON:
            self.scale(math.sqrt(EPSILON / epsilon))
        self.activate(LAYER_NORM)

    def layers(self) -> tuple[Layer, ...]:
        """All layers.

        Raises:
            InputError: there are none, since it leaves values as they are.
        """
        if self._map and not _is_nothing(*self._map):
            self.activate("linear")
        if not self._layers:
            raise InputError("it leaves what it takes as it is, so there is nothing to convert")
        return tuple(self._layers)


def _is_nothing(weight: Array, bias: Array) -> bool:
    """Whether an affine map leaves values as they are."""
    same = weight.shape[0] == weight.shape[1] and np.array_equal(weight, np.eye(len(weight)))
    return same and not bias.any()


def _row(values: Array, width: int) -> Array:
    """A row of so many numbers from one, or from a row.

    Raises:
        InputError: another shape.
    """
    if values.size == 1:
        return np.full(width, values.item())
    if values.shape not in ((width,), (1, width)):
        raise InputError(f"it has a constant of shape {values.shape}, expected ({width},)")
    return values.reshape(width)


class Action(NamedTuple):
    """What an operation does: to the chain, and as a function of one number of each of its values.

    Either is None where there is no such thing.
    """

    apply: Callable[[Chain], None] | None
    function: Callable[..., Array] | None


class Step(NamedTuple):
    """One operation on values (n, units), which depend on the observation."""

    said: str  # what messages call it
    inputs: tuple[str, ...]
    output: str
    action: Action


NOTHING = Action(lambda chain: None, lambda values: values)


def affine(weight: Any, bias: Any = 0) -> Action:
    """Dense layer: values @ weight.T + bias."""
    return Action(lambda chain: chain.affine(weight, bias), None)


def rescale(factor: Any, shift: Any = 0) -> Action:
    """Affine map of each number: values * factor + shift."""
    single = np.size(factor) == np.size(shift) == 1
    return Action(
        lambda chain: chain.scale(factor, shift),
        partial(_rescaled, np.reshape(factor, ()), np.reshape(shift, ())) if single else None,
    )


def _rescaled(factor: Array, shift: Array, values: Array) -> Array:
    return values * factor + shift


def activation(name: str) -> Action:
    """One of an encoder's activations but the layer norm."""
    return Action(lambda chain: chain.activate(name), ACTIVATIONS[name])


def elu(alpha: float) -> Action:
    """ELU.

    Raises:
        InputError: its alpha isn't 1.
    """
    if alpha != 1:
        raise InputError(f"its alpha is {alpha:g}: only 1 can be converted")
    return activation("elu")


def with_slope(name: str, beta: float) -> Action:
    """An activation f with a slope, as softplus and SiLU can have: f(beta * values) / beta.

    Raises:
        InputError: a beta that isn't positive.
    """
    if not 0 < beta < math.inf:
        raise InputError(f"its beta is {beta}: it must be positive")
    if beta == 1:
        return activation(name)

    def apply(chain: Chain) -> None:
        chain.scale(beta)
        chain.activate(name)
        chain.scale(1 / beta)

    return Action(apply, lambda values: ACTIVATIONS[name](values * beta) / beta)


def layer_norm(epsilon: float, weight: Any = None, bias: Any = None) -> Action:
    """Layer norm over the units, with its own weight and bias, (units,) each."""

    def apply(chain: Chain) -> None:
        chain.layer_norm(epsilon)
        if weight is not None or bias is not None:
            chain.scale(1 if weight is None else weight, 0 if bias is None else bias)

    return Action(apply, None)


def batch_norm(
    mean: Array, variance: Array, epsilon: float, weight: Any = None, bias: Any = None
) -> Action:
    """Batch norm in evaluation, all (units,): (values - mean) / sqrt(variance + epsilon), ..."""
    factor = (1 if weight is None else weight) / np.sqrt(variance + epsilon)
    return rescale(factor, (0 if bias is None else bias) - mean * factor)


def reshape(shape: Sequence[int]) -> Action:
    """A change of the shape to (rows, units), which must be the shape that it has."""

    def apply(chain: Chain) -> None:
        if len(shape) != 2 or shape[1] not in (0, -1, chain.width):
            raise InputError(f"it makes the shape {tuple(shape)} from (rows, {chain.width})")

    return Action(apply, None)


def binary(name: str, left: Array | None, right: Array | None) -> Action:
    """Arithmetic: add, subtract, multiply, divide or power; None stands for a value."""
    function: Callable[..., Array] = getattr(np, name)
    if left is None and right is None:
        return Action(None, function)
    if name == "add":
        return rescale(1, right if left is None else left)
    if name == "multiply":
        return rescale(right if left is None else left)
    if name == "subtract":
        return rescale(-1, left) if right is None else rescale(1, -right)
    if name == "divide" and right is not None:
        return rescale(1 / right)
    constant = np.asarray(left if right is None else right)
    if constant.size != 1:
        raise InputError(f"it has a constant of shape {constant.shape}, expected one number")
    number = constant.reshape(())
    return Action(None, lambda v: function(number, v) if right is None else function(v, number))


def erf(values: Array) -> Array:
    """The error function."""
    from scipy.special import erf as function

    return function(values)


def fold(steps: Sequence[Step], start: str, end: str, size: int) -> tuple[Layer, ...]:
    """The layers that lead from one value to another.

    Steps that follow one another are taken one by one. Where values branch, or a step alone is no
    layer, as in GELU and SiLU written out, the steps up to where one value is left are taken
    together, and are known by what they make of some numbers.

    Args:
        steps: in an order in which they can be done.
        start: the value that the layers take, (n, size).
        end: the value that they give.
        size: of the observation or latent that they take.

    Raises:
        InputError: the network is no chain of layers that an encoder can have; the message names
            the operation.
    """
    folding = _Folding(start, size)
    needed = _needed(steps, start, end)
    folding.uses.update(name for step in needed for name in step.inputs)
    folding.uses[end] += 1
    for step in needed:
        folding.take(step)
    folding.settle()
    if end not in folding.live:
        raise InputError("the output doesn't depend on the input")
    return folding.chain.layers()


def _needed(steps: Sequence[Step], start: str, end: str) -> list[Step]:
    """The steps on which the end depends, up to the start."""
    wanted, needed = {end}, []
    for step in reversed(steps):
        if step.output in wanted and step.output != start:
            wanted.update(step.inputs)
            needed.append(step)
    return needed[::-1]


class _Folding:
    """A chain so far, and the values that are still needed as functions of what it gives."""

    def __init__(self, start: str, size: int):
        self.chain = Chain(size)
        self.uses: Counter[str] = Counter()  # of values, by the steps to come
        self.live: Mapping[str, Array] = {start: _PROBES}  # what each value is at the probes
        self._open: list[str] = []  # the steps that are not in the chain yet

    def take(self, step: Step) -> None:
        """Take the next step."""
        apply, function = step.action
        if unknown := [name for name in step.inputs if name not in self.live]:
            raise InputError(refusal(step.said, f"it reads {unknown[0]}, from before the latent"))
        self.uses.subtract(step.inputs)
        rest = {name: values for name, values in self.live.items() if self.uses[name]}
        if apply and not rest and not self._open:
            try:
                apply(self.chain)
            except InputError as error:
                raise InputError(refusal(step.said, error)) from None
            self.live = {step.output: _PROBES}
            return
        if function is None:
            self.settle()
            raise InputError(refusal(step.said, "it stands in a branch of the network"))
        result = np.asarray(function(*(self.live[name] for name in step.inputs)))
        self.live = {**rest, step.output: result}
        self._open.append(step.said)
        if not rest and _recognise(result, self.chain):
            self.live, self._open = {step.output: _PROBES}, []

    def settle(self) -> None:
        """Make sure that all steps are in the chain.

        Raises:
            InputError: some aren't.
        """
        if self._open and len(self.live) == 1:
            more = ", ..." if len(self._open) > _MOST_NAMED else ""
            named = ", ".join(self._open[:_MOST_NAMED]) + more
            choices = ", ".join(ACTIVATIONS)
            raise InputError(refusal(named, f"no activation that an encoder has: {choices}"))


def refusal(said: str, reason: object) -> str:
    """The message that an operation can't be converted."""
    return f"{said} can't be converted: {reason}"


def _recognise(results: Array, chain: Chain) -> bool:
    """Add what a function makes of the probes to the chain, if it is an activation.

    It may be multiplied by a number and shifted by another.
    """
    if results.shape != _PROBES.shape or not np.isfinite(results).all():
        return False
    for name in ACTIVATIONS:
        if name in WHOLE:
            continue
        values = ACTIVATIONS[name](_PROBES)
        factor = _plain((results[-1] - results[0]) / (values[-1] - values[0]))
        shift = _plain(results[0] - factor * values[0])
        if factor and np.allclose(factor * values + shift, results, _PRECISION, _PRECISION):
            if name != "linear":
                chain.activate(name)
            if (factor, shift) != (1, 0):
                chain.scale(factor, shift)
            return True
    return False


def _plain(number: float) -> float:
    """A number without the last bits, which are left by rounding."""
    return round(float(f"{number:.12g}"), 12)
