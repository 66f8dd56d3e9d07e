"""OFENet: a code larger than the observation, from which the next observation follows."""

import copy
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, cast

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_linear_bn_eval

from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import MAX_UNITS, Layer, dense
from jbrep.envs.task import Array
from jbrep.errors import InputError
from jbrep.training.method import Learned
from jbrep.training.network import seeded
from jbrep.training.objective import Layers, Objective
from jbrep.training.settings import LearningRate


class OFE(Learned, frozen=True, kw_only=True):
    """The observation and features that help predict the next one (OFENet)."""

    name: ClassVar[str] = "ofe"
    min_reduction: ClassVar[int | None] = None

    blocks: Annotated[
        int, Meta(ge=1, le=32, description="Layers, each of which sees all that come before.")
    ] = 4
    learning_rate: LearningRate = 1e-3

    def check_data(self, data: ScaledDataset) -> None:
        super().check_data(data)
        if self.latent < data.size + self.blocks:
            raise InputError(
                f"latent size is {self.latent}: with {data.size} features, which are part of the "
                f"code, and {self.blocks} blocks it must be at least {data.size + self.blocks}"
            )
        width = (self.latent - data.size) // self.blocks  # of the last, which doubles what it takes
        if (most := 2 * self.latent - width) > MAX_UNITS:
            raise InputError(
                f"latent size is {self.latent}: a layer would have {most:,} units, at most "
                f"{MAX_UNITS:,} are possible"
            )

    def objective(self, data: ScaledDataset) -> Objective:
        return OFEObjective(self, data)


class DenseBlocks(nn.Module):
    """Layers of which each adds units to all numbers before it (DenseNet): [x, h1, h2, ...].

    A unit is silu(batch norm(w . numbers before)), as in OFENet. `widths` are the units that each
    layer adds.
    """

    def __init__(self, size: int, widths: Sequence[int]):
        super().__init__()
        self.linears, self.norms = nn.ModuleList(), nn.ModuleList()
        for width in widths:
            self.linears.append(nn.Linear(size, width))
            self.norms.append(nn.BatchNorm1d(width))
            size += width

    def forward(self, values: Tensor) -> Tensor:
        """Numbers (n, size) with all units after them."""
        for linear, norm in zip(self.linears, self.norms, strict=True):
            units = nn.functional.silu(_normalised(norm, linear(values)))
            values = torch.cat((values, units), 1)
        return values

    def layers(self) -> Layers:
        """The same as a chain of dense layers, in evaluation.

        Numbers pass through a layer's activation as x = silu(x) - silu(-x).
        """
        chain: list[Layer] = []
        restore: Array | None = None  # from what a layer gives to the numbers that it stands for
        for linear, norm in zip(self.linears, self.norms, strict=True):
            parts: Any = (copy.deepcopy(each).double().eval() for each in (linear, norm))
            weight, bias = (p.numpy(force=True) for p in fuse_linear_bn_eval(*parts).parameters())
            same = np.eye(weight.shape[1])
            rows = np.vstack((same, -same, weight))
            shift = np.concatenate((np.zeros(2 * len(same)), bias))
            chain.append(dense(rows if restore is None else rows @ restore, shift, "silu"))
            restore = np.block(
                [
                    [same, -same, np.zeros((len(same), len(weight)))],
                    [np.zeros((len(weight), 2 * len(same))), np.eye(len(weight))],
                ]
            )
        assert restore is not None  # there is a block
        return (*chain, dense(restore, np.zeros(len(restore))))


def _normalised(norm: Any, units: Tensor) -> Tensor:
    """A batch of units (n, width); a single row, which has no spread, by those before it."""
    if not norm.training or len(units) > 1:
        return cast("Tensor", norm(units))
    running = norm.running_mean, norm.running_var
    return nn.functional.batch_norm(units, *running, norm.weight, norm.bias, eps=norm.eps)


class OFEObjective(Objective):
    """The mean squared error of the next row, from features of row and action (Ota et al. 2020).

    z = blocks(x) of a row, then the next row is linear in more blocks of (z, action).
    """

    def __init__(self, method: OFE, data: ScaledDataset):
        super().__init__()
        self._size = data.size
        parts = np.array_split(np.zeros(method.latent - data.size), method.blocks)
        widths = [len(part) for part in parts]
        inputs = method.latent + data.task.action_size
        with seeded(method.seed):
            self.blocks = DenseBlocks(data.size, widths)
            self.encoder = nn.Sequential(self.blocks)
            self.beside_action = DenseBlocks(inputs, widths)
            self.next_row = nn.Linear(inputs + sum(widths), data.size)

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        now, actions, after = batch
        known = self.beside_action(torch.cat((self.encoder(now), actions), 1))
        error: Tensor = (self.next_row(known) - after).square().mean()
        return error

    def layers(self) -> tuple[Layers, Layers | None]:
        encoder = self.blocks.layers()
        rows = np.eye(self._size, len(encoder[-1].bias))
        return encoder, (dense(rows, np.zeros(self._size)),)
