"""Regressions of many quantities at once, by networks whose time is bounded."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

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
_BLOCK = 1 << 13  # rows predicted at a time


class Problem(NamedTuple):
    """What is to be predicted from what."""

    values: NDArray[Any]  # to predict from, (n, p)
    wanted: NDArray[Any]  # to predict, (n, q)
    share: float = 1.0  # of the usual steps, where fewer are enough or rows are of few episodes


class Networks(NamedTuple):
    """What was learnt from the latents of an encoder."""

    forward: dict[int, Predictor]  # what comes next, by the number of steps ahead
    probe: Predictor  # the state
    of_policy: dict[str, Predictor]  # a good policy's `action`, and `value 0` and so on by fold


def fit(problems: Sequence[Problem]) -> list[Predictor]:
    """Fit a network to each problem: three hidden layers of 64 ReLU units, by Adam.

    1,000 steps with 256 rows each, fewer if that is more than 20 times all rows of a problem.
    Values and what is wanted are standardised, and values limited to 5 standard deviations. The
    networks learn independently, but those of as many steps are multiplied at once: with so few
    units, calls would take most of the time.
    """
    steps = [
        max(1, min(int(_STEPS * each.share), _PASSES * len(each.values) // _BATCH))
        for each in problems
    ]
    fitted: dict[int, Predictor] = {}
    with single_torch_thread():
        for count in dict.fromkeys(steps):
            among = [i for i, each in enumerate(steps) if each == count]
            fitted |= zip(among, _fit([problems[i] for i in among], count), strict=True)
    return [fitted[i] for i in range(len(problems))]


def beside(*predictors: Predictor) -> Predictor:
    """What several predict from the same values, side by side."""
    return lambda values: np.hstack([predict(values) for predict in predictors])


class _Standard:
    """Columns (n, p) brought to mean 0 and deviation 1; constant ones become 0."""

    def __init__(self, values: NDArray[Any]):
        self.mean = values.mean(axis=0, dtype=np.float64)
        deviation = values.std(axis=0, dtype=np.float64)
        varies = deviation > _NEGLIGIBLE * np.abs(values).max(axis=0)
        self.deviation = np.where(varies, deviation, 0)
        self._factor = np.where(varies, 1 / np.where(varies, deviation, 1), 0)

    def __call__(self, values: NDArray[Any]) -> Tensor:
        return torch.from_numpy(((values - self.mean) * self._factor).astype(np.float32))


def _fit(problems: Sequence[Problem], steps: int) -> list[Predictor]:
    """Fit networks for that many steps; narrower ones are padded with zeros, which stay zeros."""
    input_scalers = [_Standard(problem.values) for problem in problems]
    target_scalers = [_Standard(problem.wanted) for problem in problems]
    inputs, outputs = (max(len(s.mean) for s in each) for each in (input_scalers, target_scalers))

    def scaled_inputs(i: int, values: NDArray[Any]) -> Tensor:
        limited = input_scalers[i](values).clamp_(-_LIMIT, _LIMIT)
        return pad(limited, (0, inputs - limited.shape[1]))

    def predictor(i: int, network: list[Tensor]) -> Predictor:
        def predict(values: NDArray[Any]) -> Array:
            with single_torch_thread(), torch.inference_mode():
                blocks = [_apply(network, each) for each in scaled_inputs(i, values).split(_BLOCK)]
                scaled = torch.cat(blocks)[:, : len(target_scalers[i].mean)].numpy()
            return scaled * target_scalers[i].deviation + target_scalers[i].mean

        return predict

    initial, drawn = list[list[Tensor]](), list[Tensor]()
    inputs_of, targets_of = list[Tensor](), list[Tensor]()
    for i, problem in enumerate(problems):  # each as if it were alone
        random, first = torch.Generator().manual_seed(0), sum(map(len, inputs_of))
        target = target_scalers[i](problem.wanted)
        initial.append(_begin(problem.values.shape[1], target.shape[1], inputs, outputs, random))
        numbers = torch.rand(steps, _BATCH, generator=random, dtype=torch.float64)
        drawn.append((numbers * len(problem.values)).long() + first)
        inputs_of.append(scaled_inputs(i, problem.values))
        targets_of.append(pad(target, (0, outputs - target.shape[1])))
    network = [torch.stack(parts).requires_grad_() for parts in zip(*initial, strict=True)]
    widths = torch.tensor([len(each.mean) for each in target_scalers])[:, None, None]
    all_inputs, all_targets = torch.cat(inputs_of), torch.cat(targets_of)
    adam = torch.optim.Adam(network, lr=_LEARNING_RATE, fused=True)
    for step, batch in enumerate(torch.stack(drawn, 1)):
        warm_up, decay = (step + 1) / (_RISING * steps), (1 + math.cos(math.pi * step / steps)) / 2
        adam.param_groups[0]["lr"] = _LEARNING_RATE * min(warm_up, 1) * decay
        error = _apply(network, all_inputs[batch]) - all_targets[batch]
        adam.zero_grad()
        ((error.square() / widths).sum() / _BATCH).backward()
        adam.step()
    return [predictor(i, [part[i].detach() for part in network]) for i in range(len(problems))]


def _begin(
    own_inputs: int, own_outputs: int, inputs: int, outputs: int, random: torch.Generator
) -> list[Tensor]:
    """Initial weights by He et al. 2015, small ones in the last layer, and biases of 0, in turn."""
    network: list[Tensor] = []
    own, sizes = (own_inputs, *_HIDDEN, own_outputs), (inputs, *_HIDDEN, outputs)
    for (before, after), (rows, columns) in zip(pairwise(own), pairwise(sizes), strict=True):
        scale = math.sqrt(2 / before) * (0.1 if len(network) == 2 * len(_HIDDEN) else 1)
        weight = torch.randn(before, after, generator=random) * scale
        padded = pad(weight, (0, columns - after, 0, rows - before))
        network += [padded, torch.zeros(1, columns)]
    return network


def _apply(network: list[Tensor], values: Tensor) -> Tensor:
    *layers, (weight, bias) = zip(network[::2], network[1::2], strict=True)
    for inner, shift in layers:
        values = (values @ inner + shift).relu()
    return values @ weight + bias
