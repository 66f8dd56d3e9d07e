"""Training the autoencoder: corruption, batches, epochs."""

import math
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss
from torch.optim import Adam

from jbrep.dae.adam import allocate_adam_state
from jbrep.dae.gradient import Gradient
from jbrep.dae.network import Autoencoder, get_architecture
from jbrep.errors import InputError

_MOST = 1 << 63  # numbers that torch takes are smaller
NOISE = 0.1  # standard deviation, of features scaled to [-1, 1]
_TOGETHER = 4  # batches drawn at once
_Item = TypeVar("_Item")


@dataclass(frozen=True, kw_only=True)
class Training:
    """How to train; together with the data it decides the weights on a given device."""

    latent: int
    architecture: str
    epochs: int
    batch_size: int
    learning_rate: float
    noise: float
    seed: int

    @classmethod
    def of(
        cls,
        latent: int,
        architecture: str = "paper",
        *,
        epochs: int | None = None,
        batch_size: int = 8192,
        learning_rate: float | None = None,
        noise: float = NOISE,
        seed: int = 0,
    ) -> "Training":
        """The architecture's own epochs and learning rate where none are given.

        Raises:
            InputError: unknown architecture, or a number out of range.
        """
        usual = get_architecture(architecture)
        training = cls(
            latent=latent,
            architecture=architecture,
            epochs=usual.epochs if epochs is None else epochs,
            batch_size=batch_size,
            learning_rate=usual.learning_rate if learning_rate is None else learning_rate,
            noise=noise,
            seed=seed,
        )
        training.check()
        return training

    def check(self) -> None:
        """Make sure that it can be done.

        Raises:
            InputError: it can't.
        """
        for name, least in (("epochs", 1), ("batch_size", 1), ("seed", 0)):
            if not least <= getattr(self, name) < _MOST:
                said = name.replace("_", " ")
                raise InputError(
                    f"{said} is {getattr(self, name)}: from {least} to {_MOST - 1} is needed"
                )
        if not 0 < self.learning_rate < np.inf or not 0 <= self.noise < np.inf:
            raise InputError(
                f"learning rate {self.learning_rate} and noise {self.noise}: a positive number and "
                "one from 0 are needed"
            )


class Epoch(NamedTuple):
    """What an epoch came to."""

    train_loss: float  # mean over the epoch, from corrupted rows
    test_loss: float  # from clean held-out rows


def get_device(name: str) -> torch.device:
    """The device cpu or cuda; auto takes a GPU where there is one.

    Raises:
        InputError: another name, or no GPU here.
    """
    gpu = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if gpu else "cpu")
    if name not in ("cpu", "cuda") or (name == "cuda" and not gpu):
        here = "auto, cpu or cuda" if gpu else "auto or cpu"
        raise InputError(f"no device {name!r} here: take {here}")
    return torch.device(name)


class Trainer:
    """An autoencoder in training, an epoch at a time.

    An epoch's order and noise are drawn from the seed and its number, so that training goes on
    from any epoch as it would have.

    Args:
        training: how.
        train: scaled rows to train on, (n, d), on the device to train on.
        test: scaled rows to watch, (m, d), there.

    Attributes:
        network: as the last epoch left it.
        optimiser: likewise.
        best: parameters after the epoch with the lowest training loss; held-out rows choose
            nothing.
        history: the epochs so far.
    """

    def __init__(self, training: Training, train: Tensor, test: Tensor):
        self.training = training
        self._train, self._test = train, test
        architecture = get_architecture(training.architecture)
        size = train.shape[1]
        network = Autoencoder(architecture, size, training.latent, training.seed)
        self.network = network.to(train.device)
        self.best = _copy(self.network)
        modules = (*self.network.encoder, *self.network.decoder)
        self._batch_size = min(training.batch_size, len(train))
        self._gradient = Gradient(modules, self._batch_size)
        self.optimiser = Adam(self.network.parameters(), training.learning_rate, fused=True)
        self._decay = architecture.decay
        allocate_adam_state(self.optimiser)
        self.history: list[Epoch] = []

    @property
    def best_epoch(self) -> int:
        """The epoch with the lowest training loss so far, from 1; 0 before the first."""
        losses = [epoch.train_loss for epoch in self.history]
        return losses.index(min(losses)) + 1 if losses else 0

    def epochs(self) -> Iterator[Epoch]:
        """Train to the end, an epoch for each that is asked for."""
        with single_torch_thread():
            while len(self.history) < self.training.epochs:
                self._epoch()
                yield self.history[-1]

    def _epoch(self) -> None:
        number = len(self.history) + 1
        total = torch.zeros((), device=self._train.device)
        for i, (clean, corrupted) in enumerate(self._batches(number)):
            self.optimiser.param_groups[0]["lr"] = self._learning_rate(number, i)
            total += self._gradient(corrupted, clean) * clean.shape[1]
            self.optimiser.step()
        train_loss = float(total) / len(self._train)
        with torch.no_grad():
            test_loss = float(mse_loss(self.network(self._test), self._test))
        if not math.isfinite(train_loss) or not math.isfinite(test_loss):
            raise InputError(
                f"the losses are {train_loss} and {test_loss} in epoch {number}: less noise than "
                f"{self.training.noise}, or a learning rate below {self.training.learning_rate}, "
                "is needed"
            )
        if all(train_loss < epoch.train_loss for epoch in self.history):
            self.best = _copy(self.network)
        self.history.append(Epoch(train_loss, test_loss))

    def _learning_rate(self, number: int, batch: int) -> float:
        if not self._decay:
            return self.training.learning_rate
        batches = -(-len(self._train) // self._batch_size)
        done = (number - 1 + batch / batches) / self.training.epochs
        return self.training.learning_rate * (1 + math.cos(math.pi * done)) / 2

    def _batches(self, number: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Every row once, (d, rows): clean, and with noise of its own on each feature."""
        size = self._batch_size
        for clean, corrupted in prefetch(self._draws(number)):
            yield from zip(clean.split(size, 1), corrupted.split(size, 1), strict=True)

    def _draws(self, number: int) -> Iterator[tuple[Tensor, Tensor]]:
        """The same, some batches at a time."""
        rows, noise = self._train, self.training.noise
        words = np.random.SeedSequence((self.training.seed, number)).generate_state(1, np.uint64)
        generator = torch.Generator(rows.device).manual_seed(int(words[0]))
        order = torch.randperm(len(rows), generator=generator, device=rows.device)
        for batches in order.split(_TOGETHER * self._batch_size):
            clean = rows.index_select(0, batches).T.contiguous()
            if noise:
                drawn = torch.empty_like(clean).normal_(0, noise, generator=generator)
                yield clean, drawn.add_(clean)
            else:
                yield clean, clean


def _copy(network: Autoencoder) -> dict[str, Tensor]:
    return {name: p.clone() for name, p in network.state_dict().items()}


def prefetch(items: Iterable[_Item]) -> Iterator[_Item]:
    """The items in order, each made in another thread while the one before it is used."""
    iterator = iter(items)
    with ThreadPoolExecutor(1) as executor:
        upcoming = executor.submit(next, iterator, None)
        while (item := upcoming.result()) is not None:
            upcoming = executor.submit(next, iterator, None)
            yield item


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Torch on one: networks so small gain little from more, which move the last bits and wait."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
