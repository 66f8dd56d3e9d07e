"""The denoising autoencoder: network, corruption, training."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import nn
from tqdm import trange

from jbrep.dataset import Dataset
from jbrep.encoders import Encoder
from jbrep.errors import InputError


@dataclass(frozen=True)
class Training:
    """How to train; the defaults are the paper's."""

    latent: int
    epochs: int = 200
    batch_size: int = 8192
    learning_rate: float = 5e-4
    noise: float = 0.1  # standard deviation, of features scaled to [-1, 1]
    seed: int = 0


def make_network(size: int, latent: int) -> nn.Sequential:
    """Layers d to l to d, with tanh after each layer."""
    return nn.Sequential(nn.Linear(size, latent), nn.Tanh(), nn.Linear(latent, size), nn.Tanh())


def train(dataset: Dataset, training: Training) -> Encoder:
    """Train on 80 % of the episodes; the held-out error is in the header's metrics.

    Raises:
        InputError: a latent size that is not in [1, d], or a data set of one episode.
    """
    task = dataset.task
    if not 1 <= training.latent <= task.size:
        raise InputError(
            f"the latent size is {training.latent}: {task.name} has {task.size} features, so it "
            f"must be from 1 to {task.size}"
        )
    train_rows, test_rows = dataset.split()
    scaler = dataset.fit_scaler(train_rows)
    low, high = task.scale(np.stack((scaler.low, scaler.high)).astype(np.float64))
    unit = torch.from_numpy(scaler.scale(dataset["observation"][:]))

    generator = torch.Generator().manual_seed(training.seed)
    with torch.random.fork_rng():
        torch.manual_seed(training.seed)
        network = make_network(task.size, training.latent)
    with _one_thread():
        _fit(network, unit[train_rows], training, generator)
    with torch.no_grad():
        error = nn.functional.mse_loss(network(unit[test_rows]), unit[test_rows]).item()
    header = {
        "kind": "dae",
        "task": task.name,
        "feature_names": list(task.feature_names),
        "training": asdict(training),
        "metrics": {"held_out_mse": error, "held_out_rows": len(test_rows)},
    }
    weights = [parameter.detach().numpy() for parameter in network.parameters()]
    return Encoder(header, low.astype(np.float32), high.astype(np.float32), *weights)


@contextmanager
def _one_thread() -> Iterator[None]:
    """So small a network gains nothing from more threads, and waits long where cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _fit(
    network: nn.Module, rows: torch.Tensor, training: Training, generator: torch.Generator
) -> None:
    """Minimise the error between clean rows and the reconstruction of corrupted ones."""
    optimiser = torch.optim.Adam(network.parameters(), training.learning_rate)
    progress = trange(training.epochs, unit="epoch", desc=f"dae l={training.latent}")
    for _ in progress:
        order = torch.randperm(len(rows), generator=generator)
        for batch in order.split(training.batch_size):
            clean = rows[batch]
            noise = training.noise * torch.randn(clean.shape, generator=generator)
            loss = nn.functional.mse_loss(network(clean + noise), clean)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        progress.set_postfix(train_mse=f"{loss.item():.4f}")
