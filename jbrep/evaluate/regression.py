"""Nonlinear regression of many quantities at once, in the same time however many rows there are."""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from jbrep.dae.gradient import Gradient
from jbrep.dae.network import stack
from jbrep.stats.bootstrap import Array
from jbrep.training.trainer import single_torch_thread

Predictor = Callable[[NDArray[Any]], Array]  # values (n, p) to what is predicted, (n, q)

_HIDDEN = (64, 64, 64)  # units
_STEPS = 1000  # at most
_PASSES = 20  # over the rows, at most: few rows are soon known by heart
_BATCH = 256
_LEARNING_RATE = 5e-3  # at its highest
_RISING = 0.1  # the share of the steps in which the learning rate rises to that
_LIMIT = 5.0  # standard deviations within which the network sees its input
_NEGLIGIBLE = 1e-9  # standard deviation, as a share of the largest magnitude: rounding
_BLOCK = 1 << 13  # rows predicted at a time


class Problem(NamedTuple):
    """What is to be predicted from what.

    Attributes:
        values: to predict from, (n, p).
        wanted: to predict, (n, q).
        weights: of the squared errors of what is wanted, (q,); None if all count alike.
    """

    values: NDArray[Any]
    wanted: NDArray[Any]
    weights: NDArray[Any] | None = None


def fit(problems: Sequence[Problem]) -> list[Predictor]:
    """Fit a network to each problem: three hidden layers of 64 ReLU units, by Adam.

    1,000 steps with 256 rows each, fewer if that is more than 20 times all rows. Values and what is
    wanted are standardised, and values limited to 5 standard deviations. The networks are fitted
    side by side, one on each core, and each comes out the same to the last bit however many there
    are.
    """
    with single_torch_thread(), ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(_fit, problems))


def _fit(problem: Problem) -> Predictor:
    values, wanted, weights = problem
    enter, _ = _standard(values)
    leave, scale = _standard(wanted)
    network = _trained(
        enter(values).clamp_(-_LIMIT, _LIMIT),
        leave(wanted),
        torch.ones(wanted.shape[1]) if weights is None else torch.from_numpy(weights).float(),
    )
    mean = wanted.mean(axis=0, dtype=np.float64)

    def predict(others: NDArray[Any]) -> Array:
        with single_torch_thread(), torch.inference_mode():
            blocks = enter(others).clamp_(-_LIMIT, _LIMIT).split(_BLOCK)
            return torch.cat([network(block) for block in blocks]).numpy() * scale + mean

    return predict


def _standard(values: NDArray[Any]) -> tuple[Callable[[NDArray[Any]], Tensor], Array]:
    """A map to columns of mean 0 and deviation 1, and these deviations; constant ones become 0."""
    mean, deviation = (getattr(values, name)(axis=0, dtype=np.float64) for name in ("mean", "std"))
    varies = deviation > _NEGLIGIBLE * np.abs(values).max(axis=0)
    scale = np.where(varies, deviation, 0)
    factor = np.where(varies, 1 / np.where(varies, deviation, 1), 0)
    return lambda others: torch.from_numpy(((others - mean) * factor).astype(np.float32)), scale


def _trained(values: Tensor, wanted: Tensor, weights: Tensor) -> nn.Sequential:
    """The network after its training."""
    random = torch.Generator().manual_seed(0)
    network = stack((values.shape[1], *_HIDDEN, wanted.shape[1]), "linear")
    dense = [module for module in network if isinstance(module, nn.Linear)]
    with torch.no_grad():
        for layer in dense:
            spread = (2 / layer.in_features) ** 0.5  # He et al. 2015
            layer.weight.normal_(0, spread, generator=random)
            layer.bias.zero_()
        dense[-1].weight.mul_(0.1)
    steps = max(1, min(_STEPS, _PASSES * len(values) // _BATCH))
    gradient = Gradient(network, _BATCH, weights)
    adam = torch.optim.Adam(network.parameters(), lr=_LEARNING_RATE, fused=True)
    for step in range(steps):
        rising, falling = (step + 1) / (_RISING * steps), (1 + math.cos(math.pi * step / steps)) / 2
        adam.param_groups[0]["lr"] = _LEARNING_RATE * min(rising, 1) * falling
        rows = torch.randint(len(values), (_BATCH,), generator=random)
        gradient(values[rows].T, wanted[rows].T)
        adam.step()
    return network
