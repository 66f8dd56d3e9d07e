"""Regressions of many quantities at once: linear ones, and networks whose time is bounded."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from jbrep.stats.bootstrap import Array
from jbrep.training.trainer import single_torch_thread

Predictor = Callable[[NDArray[Any]], Array]  # values (n, p) to what is predicted, (n, q)

_HIDDEN = (64, 64, 64)  # units
_STEPS = 1000  # at most
_PASSES = 20  # over the rows, at most: few rows are soon known by heart
_BATCH = 256
_LEARNING_RATE = 1e-2  # at its highest
_RISING = 0.1  # the share of the steps in which the learning rate rises to that
_LIMIT = 5.0  # standard deviations within which the network sees its input
_NEGLIGIBLE = 1e-9  # standard deviation, as a share of the largest magnitude: rounding
_FAR = 20.0  # standard deviations within which ridge regressions see theirs
_BLOCK = 1 << 13  # rows predicted at a time
_PENALTY = 1.0  # of the ridge, on standardised values


def ridge(values: NDArray[Any], wanted: NDArray[Any]) -> Predictor:
    """Ridge regressions of all columns (n, k) on standardised values (n, l), as a map.

    Far values count as those at 20 standard deviations: a unit that is constant but for rounding
    where the regression is fitted could otherwise outweigh all others where it isn't.
    """
    from sklearn.linear_model import Ridge  # not at the top: it takes seconds
    from sklearn.preprocessing import StandardScaler

    scaler, model = StandardScaler(), Ridge(_PENALTY)
    # in float64: features may be as good as collinear
    model.fit(scaler.fit_transform(values.astype(np.float64)), wanted)

    def predict(others: NDArray[Any]) -> NDArray[Any]:
        standardised = scaler.transform(others.astype(np.float64))
        predicted: NDArray[Any] = model.predict(standardised.clip(-_FAR, _FAR))
        return predicted.reshape(len(others), -1)

    return predict


class Problem(NamedTuple):
    """What is to be predicted from what.

    Attributes:
        values: to predict from, (n, p).
        wanted: to predict, (n, q).
        share: of the usual steps that are taken; less where these are enough, or where rows are of
            few episodes, which a network soon knows by heart.
    """

    values: NDArray[Any]
    wanted: NDArray[Any]
    share: float = 1.0


class Networks(NamedTuple):
    """What was learnt from the latents of an encoder.

    Attributes:
        forward: what comes next, by the number of steps ahead.
        probe: the state.
        of_policy: a good policy's `action` and, unless its episodes are too few, its `value 0` and
            so on, of each fold; nothing without one.
    """

    forward: dict[int, Predictor]
    probe: Predictor
    of_policy: dict[str, Predictor]


def fit(problems: Sequence[Problem]) -> list[Predictor]:
    """Fit a network to each problem: three hidden layers of 64 ReLU units, by Adam.

    1,000 steps with 256 rows each, fewer if that is more than 20 times all rows of a problem.
    Values and what is wanted are standardised, and values limited to 5 standard deviations. The
    networks learn independently, but those of as many steps are multiplied at once: with so few
    units, calls would take most of the time.
    """
    steps = [_steps(each) for each in problems]
    fitted: dict[int, Predictor] = {}
    for count in dict.fromkeys(steps):
        among = [i for i, each in enumerate(steps) if each == count]
        fitted |= zip(among, _fit([problems[i] for i in among], count), strict=True)
    return [fitted[i] for i in range(len(problems))]


def beside(*predictors: Predictor) -> Predictor:
    """What several predict from the same values, side by side."""
    return lambda values: np.hstack([predict(values) for predict in predictors])


def _steps(problem: Problem) -> int:
    return max(1, min(int(_STEPS * problem.share), _PASSES * len(problem.values) // _BATCH))


def _fit(problems: list[Problem], steps: int) -> list[Predictor]:
    """As `fit`, in so many steps."""
    enter = [_Standard(problem.values) for problem in problems]
    leave = [_Standard(problem.wanted) for problem in problems]
    values = [at(p.values).clamp_(-_LIMIT, _LIMIT) for at, p in zip(enter, problems, strict=True)]
    wanted = [to(p.wanted) for to, p in zip(leave, problems, strict=True)]
    with single_torch_thread():
        network = _trained(values, wanted, steps)
    return [
        partial(_predict, _one_of(network, i, at, to), at, to)
        for i, (at, to) in enumerate(zip(enter, leave, strict=True))
    ]


def _one_of(network: list[Tensor], i: int, enter: "_Standard", leave: "_Standard") -> list[Tensor]:
    """One of the networks, without what fills it up."""
    own = [part[i] for part in network]
    inputs, outputs = len(enter.mean), len(leave.mean)
    return [own[0][:inputs], *own[1:-2], own[-2][:, :outputs], own[-1][:, :outputs]]


def _predict(
    network: list[Tensor], enter: "_Standard", leave: "_Standard", values: NDArray[Any]
) -> Array:
    with single_torch_thread(), torch.inference_mode():
        blocks = enter(values).clamp_(-_LIMIT, _LIMIT).split(_BLOCK)
        given = torch.cat([_apply(network, block) for block in blocks]).numpy()
    return given * leave.deviation + leave.mean


class _Standard:
    """Columns brought to mean 0 and deviation 1; constant ones become 0.

    Attributes:
        mean: of each column, (p,).
        deviation: of each column, (p,); 0 for constant ones.
    """

    def __init__(self, values: NDArray[Any]):
        self.mean, deviation = (
            getattr(values, name)(axis=0, dtype=np.float64) for name in ("mean", "std")
        )
        varies = deviation > _NEGLIGIBLE * np.abs(values).max(axis=0)
        self.deviation = np.where(varies, deviation, 0)
        self._factor = np.where(varies, 1 / np.where(varies, deviation, 1), 0)

    def __call__(self, values: NDArray[Any]) -> Tensor:
        return torch.from_numpy(((values - self.mean) * self._factor).astype(np.float32))


def _trained(values: list[Tensor], wanted: list[Tensor], steps: int) -> list[Tensor]:
    """Weights (m, in, out) and biases (m, 1, out) of each layer of m networks, in turn.

    Values (n, p) and what is wanted (n, q) are of each network; narrower ones are filled up with
    zeros, from which nothing is learnt.
    """
    seen, true = (_padded(each) for each in (values, wanted))
    widths = torch.tensor([each.shape[1] for each in wanted])[:, None, None]
    begun, drawn, first = [], [], 0
    for now, then in zip(values, wanted, strict=True):  # each as if it were alone
        random = torch.Generator().manual_seed(0)
        begun.append(_begin((now.shape[1], *_HIDDEN, then.shape[1]), random))
        numbers = torch.rand(steps, _BATCH, generator=random, dtype=torch.float64)
        drawn.append((numbers * len(now)).long() + first)
        first += len(now)
    network = [_stacked(parts).requires_grad_() for parts in zip(*begun, strict=True)]
    adam = torch.optim.Adam(network, lr=_LEARNING_RATE, fused=True)
    for step, rows in enumerate(torch.stack(drawn, 1)):
        rising, falling = (step + 1) / (_RISING * steps), (1 + math.cos(math.pi * step / steps)) / 2
        adam.param_groups[0]["lr"] = _LEARNING_RATE * min(rising, 1) * falling
        error = _apply(network, seen[rows]) - true[rows]
        adam.zero_grad()
        ((error.square() / widths).sum() / _BATCH).backward()
        adam.step()
    return [each.detach() for each in network]


def _begin(sizes: Sequence[int], random: torch.Generator) -> list[Tensor]:
    """Initial weights by He et al. 2015, small ones in the last layer, and biases of 0."""
    network = []
    for i, (before, after) in enumerate(pairwise(sizes)):
        scale = math.sqrt(2 / before) * (0.1 if i == len(_HIDDEN) else 1)
        network += [torch.randn(before, after, generator=random) * scale, torch.zeros(1, after)]
    return network


def _padded(parts: Sequence[Tensor]) -> Tensor:
    """The rows (n, p) of all parts, one after the other, with zeros up to the widest."""
    widest = max(part.shape[1] for part in parts)
    return torch.cat([functional.pad(part, (0, widest - part.shape[1])) for part in parts])


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    """Matrices (n, p) side by side, (m, n, p), with zeros up to the largest."""
    rows, columns = (max(part.shape[axis] for part in parts) for axis in (0, 1))
    return torch.stack(
        [functional.pad(p, (0, columns - p.shape[1], 0, rows - p.shape[0])) for p in parts]
    )


def _apply(network: list[Tensor], values: Tensor) -> Tensor:
    *layers, (weight, bias) = zip(network[::2], network[1::2], strict=True)
    for inner, shift in layers:
        values = (values @ inner + shift).relu()
    return values @ weight + bias
