"""Networks given as operations on values, brought into a chain of dense layers."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.layers import ACTIVATIONS, EPSILON, LAYER_NORM, MAX_UNITS, WHOLE, Layer
from jbrep.errors import InputError, listed

Array = NDArray[np.float64]

_HALF = np.concatenate((np.linspace(0, 8, 65)[1:], np.geomspace(8, 100, 40)))
_PROBES: Array = np.concatenate((-_HALF[::-1], [0], _HALF))  # of functions of one number
_PRECISION = 1e-6  # to which a function must be an activation
_MOST_NUMBERS = 1 << 26  # in layers: few nodes of a stranger's model can make many
_MOST_FORMS = 4  # of a value: a GELU written out needs two


@dataclass(frozen=True, eq=False)
class Chain:
    """Layers from affine maps, of which any number in a row become one, and activations.

    Affine maps are multiplied in float64; the layers are float32. A chain never changes: whatever
    adds to it makes another.

    Attributes:
        width: numbers that it gives.
        ended: layers with their activations.
        last: weight (out, in) and bias (out,) of the map after them, if there is one.
    """

    width: int
    ended: tuple[Layer, ...] = ()
    last: tuple[Array, Array] | None = None

    def affine(self, weight: Any, bias: Any = 0) -> "Chain":
        """Add values @ weight.T + bias.

        Args:
            weight: (out, in).
            bias: (out,), or one number.
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
        if self.last:
            before, shift = self.last
            weight, bias = weight @ before, weight @ shift + bias
        return Chain(outputs, self.ended, (weight, bias))

    def scale(self, factor: Any, shift: Any = 0) -> "Chain":
        """Add values * factor + shift, each (width,) or one number."""
        factor, shift = (_row(np.asarray(v, np.float64), self.width) for v in (factor, shift))
        weight, bias = self._affine()
        return Chain(self.width, self.ended, (weight * factor[:, None], bias * factor + shift))

    def activate(self, name: str) -> "Chain":
        """Add an activation, which ends a layer."""
        weight, bias = self._affine()
        if sum(layer.weight.size for layer in self.ended) + weight.size > _MOST_NUMBERS:
            raise InputError(f"its layers have more than {_MOST_NUMBERS:,} numbers")
        single = np.asarray(weight, np.float32, order="C"), np.float32(bias + 0.0)  # no -0.0
        return Chain(self.width, (*self.ended, Layer(*single, name)))

    def _affine(self) -> tuple[Array, Array]:
        return self.last or (np.eye(self.width), np.zeros(self.width))

    def layer_norm(self, epsilon: float) -> "Chain":
        """Add a layer norm without weights of its own.

        With another epsilon than an encoder's it is the same one of values that are scaled: both
        then divide by the same number.
        """
        if not 0 < epsilon < math.inf:
            raise InputError(f"its epsilon is {epsilon}: it must be positive")
        scaled = self if epsilon == EPSILON else self.scale(math.sqrt(EPSILON / epsilon))
        return scaled.activate(LAYER_NORM)

    def layers(self) -> tuple[Layer, ...]:
        """All layers."""
        if self.last:
            weight, bias = self.last
            if len(bias) != weight.shape[1] or bias.any() or (weight != np.eye(len(bias))).any():
                return self.activate("linear").ended
        if not self.ended:
            raise InputError("it leaves what it takes as it is, so there is nothing to convert")
        return self.ended


def _row(values: Array, width: int) -> Array:
    """A row of so many numbers from one, or from a row."""
    if values.size == 1:
        return np.full(width, values.item())
    if values.shape not in ((width,), (1, width)):
        raise InputError(f"it has a constant of shape {values.shape}, expected ({width},)")
    return values.reshape(width)


class Action(NamedTuple):
    """What an operation does: to a chain, and as a function of one number of each of its values.

    Either is None where there is no such thing.
    """

    apply: Callable[[Chain], Chain] | None
    function: Callable[..., Array] | None


class _Form(NamedTuple):
    """What a value is as a function of one number that a chain gives: at the probes."""

    numbers: Array
    said: tuple[str, ...] = ()  # the operations of the function


@dataclass(frozen=True, eq=False)
class Value:
    """Numbers (n, units) that depend on the observation.

    Attributes:
        forms: by the last chains that they can be known from. Where a chain gives the numbers
            themselves, it is the last of these.
    """

    forms: dict[Chain, _Form]

    @property
    def unknown(self) -> tuple[str, ...]:
        """The operations that make them and are no chain, as far as is known."""
        return [*self.forms.values()][-1].said

    @property
    def chain(self) -> Chain:
        """The chain that gives these numbers."""
        if unknown := self.unknown:
            choices = ", ".join(ACTIVATIONS)
            raise InputError(
                refusal(listed(unknown), f"no activation that an encoder has: {choices}")
            )
        return [*self.forms][-1]


def given(size: int) -> Value:
    """The numbers (n, size) that the layers take."""
    return Value({Chain(size): _Form(_PROBES)})


def layers_to(end: object) -> tuple[Layer, ...]:
    """The layers that lead to what a network gives."""
    if not isinstance(end, Value):
        raise InputError("the output doesn't depend on the input")
    return end.chain.layers()


def take(said: str, action: Action, values: Sequence[Value]) -> Value:
    """What an operation makes of values.

    An operation that is a layer, or part of one, is added to the chain. Others, as in GELU and SiLU
    written out, are taken together, and are known by what they make of some numbers.

    Args:
        said: what messages call it.
        action: what it does.
        values: in the order in which its function takes them.
    """
    forms = dict[Chain, _Form]()
    if action.function:
        for chain in values[0].forms:
            if all(chain in value.forms for value in values):
                known = [value.forms[chain] for value in values]
                result = np.asarray(action.function(*(form.numbers for form in known)))
                names = dict.fromkeys(name for form in known for name in form.said)
                forms[chain] = _Form(result, (*names, said))
    if action.apply and len(values) == 1 and not (forms and values[0].unknown):
        before = values[0].chain
        try:
            return _known(forms, action.apply(before))
        except InputError as error:
            raise InputError(refusal(said, error)) from None
    if not forms:
        raise InputError(refusal(said, "it stands in a branch of the network"))
    for chain, form in reversed(forms.items()):
        if recognised := _recognised(form.numbers, chain):
            return _known(forms, recognised)
    return Value(forms)


def _known(forms: dict[Chain, _Form], chain: Chain) -> Value:
    """What a chain gives, and the last of the forms that it has otherwise."""
    return Value(dict([*forms.items(), (chain, _Form(_PROBES))][-_MOST_FORMS:]))


def refusal(said: str, reason: object) -> str:
    """The message that an operation can't be converted."""
    return f"{said} can't be converted: {reason}"


def _recognised(results: Array, chain: Chain) -> Chain | None:
    """The chain with what a function makes of the probes after it, if that is an activation.

    It may be multiplied by a number and shifted by another.
    """
    if results.dtype != _PROBES.dtype or not np.isfinite(results).all():
        return None
    absolute = _PRECISION * min(1.0, np.abs(results).max())  # a function may be small everywhere
    for name, function in ACTIVATIONS.items():
        if name in WHOLE:
            continue
        values = function(_PROBES)
        factor = _plain((results[-1] - results[0]) / (values[-1] - values[0]))
        shift = _plain(results[0] - factor * values[0])
        if factor and np.allclose(factor * values + shift, results, _PRECISION, absolute):
            active = chain if name == "linear" else chain.activate(name)
            return active if (factor, shift) == (1, 0) else active.scale(factor, shift)
    return None


def _plain(number: float) -> float:
    """A number without the last bits, which are left by rounding."""
    return round(float(f"{number:.12g}"), 12)
