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

from jbrep.dae.gradient import Gradient
from jbrep.dae.network import Autoencoder, get_architecture
from jbrep.errors import InputError

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
            if getattr(self, name) < least:
                said = name.replace("_", " ")
                raise InputError(f"{said} is {getattr(self, name)}: at least {least} is needed")
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
    """A device by torch's name; auto takes a GPU where there is one.

    Raises:
        InputError: torch knows none of that name here.
    """
    try:
        device = torch.device(
            ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
        )
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        why = str(error).splitlines()[0]
        raise InputError(f"no device {name!r} here: take auto, cpu or cuda ({why})") from None
    return device


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
        modules = (*self.network.encoder, *self.network.decoder)
        self._gradient = Gradient(modules, training.batch_size)
        self.optimiser = Adam(self.network.parameters(), training.learning_rate, fused=True)
        self._decay = architecture.decay
        self.best: dict[str, Tensor] = {}
        self.history: list[Epoch] = []

    @property
    def best_epoch(self) -> int:
        """The epoch with the lowest training loss so far, from 1; 0 before the first."""
        losses = [epoch.train_loss for epoch in self.history]
        return losses.index(min(losses)) + 1 if losses else 0

    def epochs(self) -> Iterator[Epoch]:
        """Train to the end, an epoch for each that is asked for."""
        with _one_thread():
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
        if not math.isfinite(train_loss):
            raise InputError(
                f"the loss is {train_loss} in epoch {number}: a learning rate below "
                f"{self.training.learning_rate} is needed"
            )
        with torch.no_grad():
            test_loss = float(mse_loss(self.network(self._test), self._test))
        self.history.append(Epoch(train_loss, test_loss))
        if self.best_epoch == number:
            self.best = {name: p.clone() for name, p in self.network.state_dict().items()}

    def _learning_rate(self, number: int, batch: int) -> float:
        if not self._decay:
            return self.training.learning_rate
        batches = -(-len(self._train) // self.training.batch_size)
        done = (number - 1 + batch / batches) / self.training.epochs
        return self.training.learning_rate * (1 + math.cos(math.pi * done)) / 2

    def _batches(self, number: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Every row once, (d, rows): clean, and with noise of its own on each feature."""
        size = self.training.batch_size
        for clean, corrupted in ahead(self._draws(number)):
            yield from zip(clean.split(size, 1), corrupted.split(size, 1), strict=True)

    def _draws(self, number: int) -> Iterator[tuple[Tensor, Tensor]]:
        """The same, some batches at a time."""
        rows, noise = self._train, self.training.noise
        words = np.random.SeedSequence((self.training.seed, number)).generate_state(1, np.uint64)
        generator = torch.Generator(rows.device).manual_seed(int(words[0]))
        order = torch.randperm(len(rows), generator=generator, device=rows.device)
        for batches in order.split(_TOGETHER * self.training.batch_size):
            clean = rows.index_select(0, batches).T.contiguous()
            if noise:
                drawn = torch.empty_like(clean).normal_(0, noise, generator=generator)
                yield clean, drawn.add_(clean)
            else:
                yield clean, clean


def ahead(items: Iterable[_Item]) -> Iterator[_Item]:
    """The items in order, each made in another thread while the one before it is used."""
    iterator = iter(items)
    with ThreadPoolExecutor(1) as executor:
        upcoming = executor.submit(next, iterator, None)
        while (item := upcoming.result()) is not None:
            upcoming = executor.submit(next, iterator, None)
            yield item


@contextmanager
def _one_thread() -> Iterator[None]:
    """So small a network gains nothing from more threads, and waits long where cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
