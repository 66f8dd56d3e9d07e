"""Training and using encoders, side by side with what a user would do instead.

python benchmarks/encoders.py; ratios are medians over rounds taken in turn, so that a machine that
slows down slows both sides.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from timing import show, timed
from torch import Tensor, nn
from torch.nn.functional import mse_loss
from torch.utils.data import DataLoader, TensorDataset

from jbrep.dae import DAE, NOISE, Gradient, Reconstruction
from jbrep.encoders import find
from jbrep.encoders.layers import run
from jbrep.envs import describe
from jbrep.training.network import ARCHITECTURES, stacks
from jbrep.training.trainer import Trainer
from jbrep.training.windows import Windows

ROWS = 4_000_000
SIZE = 16
LATENT = 8
BATCH = 8192
ROUNDS = 3
STEPS = 50
CALLS = 5_000


class Rows:
    """Windows of one row each, which are in memory already."""

    size = SIZE

    def __init__(self, rows: Tensor):
        self._rows, self.device = rows, rows.device
        self.numbers = torch.arange(len(rows), device=rows.device)

    def __len__(self) -> int:
        return len(self._rows)

    def rows(self, numbers: Tensor) -> Tensor:
        """Rows by number."""
        return self._rows.index_select(0, numbers)


def repeated(work: Callable[[], object], times: int) -> None:
    for _ in range(times):
        work()


def usual_epoch(rows: torch.Tensor) -> None:
    """The loop of every tutorial."""
    network = nn.Sequential(*stacks(ARCHITECTURES["paper"], SIZE, LATENT, seed=0)).to(rows.device)
    optimiser = torch.optim.Adam(network.parameters(), 5e-4)
    for (clean,) in DataLoader(TensorDataset(rows), BATCH, shuffle=True):
        optimiser.zero_grad()
        mse_loss(network(clean + NOISE * torch.randn_like(clean)), clean).backward()
        optimiser.step()


def our_epoch(rows: torch.Tensor) -> None:
    how = DAE(latent=LATENT, epochs=1, batch_size=BATCH, learning_rate=5e-4)
    network = Reconstruction(how, SIZE, noise=NOISE)
    train, held_out = cast("Windows", Rows(rows)), cast("Windows", Rows(rows[:1]))
    next(Trainer(network.to(rows.device), how, train, held_out).epochs())


def compare_epochs() -> None:
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    for device in devices:
        rows = torch.empty(ROWS, SIZE, device=device).uniform_(-1, 1)
        ours, usual = [], []
        for _ in range(ROUNDS):
            ours.append(timed(partial(our_epoch, rows)))
            usual.append(timed(partial(usual_epoch, rows)))
        ratios = [theirs / mine for theirs, mine in zip(usual, ours, strict=True)]
        show(f"epoch of {ROWS:,} rows, {device}: DataLoader's time / ours", ratios, "aim 15")
        show(f"rows per second, {device}, ours", [ROWS / seconds for seconds in ours])


def compare_gradients() -> None:
    for name, architecture in ARCHITECTURES.items():
        network = nn.Sequential(*stacks(architecture, SIZE, LATENT, seed=0))
        gradient = Gradient([*network[0].children(), *network[1].children()], BATCH)
        rows = torch.empty(BATCH, SIZE).uniform_(-1, 1)
        columns = rows.T.contiguous()

        def autograd(network: nn.Module = network, rows: torch.Tensor = rows) -> None:
            network.zero_grad()
            mse_loss(network(rows), rows).backward()

        written_out = partial(gradient, columns, columns)
        ratios = []
        for _ in range(2 * ROUNDS):
            theirs = timed(partial(repeated, autograd, STEPS))
            mine = timed(partial(repeated, written_out, STEPS))
            ratios.append(theirs / mine)
        show(f"gradient of {name}, a batch of {BATCH}, one thread: autograd's time / ours", ratios)


def compare_one_row() -> None:
    """What encode costs on one row beyond its own arithmetic."""
    encoder: Any = find("dae-8", describe("face_direction"))
    row = np.zeros((1, SIZE), np.float32)
    parts = {"NumPy": row, "torch": torch.from_numpy(row)}
    for library, values in parts.items():
        _, there = encoder._prepare(values, SIZE, "observations")

        def bare(values: Any = values, there: Any = there) -> object:
            return run(there.encoder, there.scaler.scale(values))

        over = []
        for _ in range(2 * ROUNDS):
            whole = timed(partial(repeated, partial(encoder.encode, values), CALLS))
            over.append((whole - timed(partial(repeated, bare, CALLS))) / CALLS)
        show(f"encode, one row, {library}: overhead [us]", [1e6 * s for s in over], "aim below 50")


if __name__ == "__main__":
    compare_epochs()  # on as many threads as each takes
    torch.set_num_threads(1)
    compare_gradients()
    compare_one_row()
