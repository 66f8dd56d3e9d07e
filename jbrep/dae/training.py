"""Training the autoencoder: corruption, batches, epochs."""

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss
from torch.optim import Adam

from jbrep.dae.adam import allocate_adam_state
from jbrep.dae.gradient import Gradient
from jbrep.dae.network import Autoencoder, get_architecture
from jbrep.dae.order import POOL, shuffled
from jbrep.errors import InputError

NOISE = 0.1  # standard deviation, of features scaled to [-1, 1]
_MAX_NUMBER = (1 << 63) - 1  # that torch accepts
_MAX_LEARNING_RATE = 1  # beyond which Adam's steps are larger than any useful weight
_MIN_BATCH, _MAX_BATCH = 128, 8192
_BATCHES = 400  # that an epoch should have
_DRAWN_AT_ONCE = 4  # batches
_Item = TypeVar("_Item")


@dataclass(frozen=True, kw_only=True)
class Training:
    """How to train; together with the data it determines the weights on a given device.

    Kinds of encoders that aren't trained take some of these settings, too: KINDS of
    jbrep.methods.fit says which.
    """

    latent: int | None  # latent units; None for a kind that has no choice of them
    architecture: str
    epochs: int
    batch_size: int | None  # None: `default_batch_size` of the training rows
    learning_rate: float
    noise: float  # standard deviation, of features scaled to [-1, 1]
    seed: int

    @classmethod
    def of(
        cls,
        latent: int | None = None,
        architecture: str = "paper",
        *,
        epochs: int | None = None,
        batch_size: int | None = None,
        learning_rate: float | None = None,
        noise: float = NOISE,
        seed: int = 0,
    ) -> "Training":
        """Use the architecture's own epochs and learning rate unless they are given.

        Raises:
            InputError: unknown architecture, or a number out of range.
        """
        defaults = get_architecture(architecture)
        training = cls(
            latent=latent,
            architecture=defaults.name,
            epochs=defaults.epochs if epochs is None else epochs,
            batch_size=batch_size,
            learning_rate=defaults.learning_rate if learning_rate is None else learning_rate,
            noise=noise,
            seed=seed,
        )
        training.check()
        return training

    def check(self) -> None:
        """Make sure that all numbers are in range.

        Raises:
            InputError: one isn't.
        """
        for name, least in (("epochs", 1), ("batch_size", 1), ("seed", 0)):
            value = getattr(self, name)
            if value is not None and not least <= value <= _MAX_NUMBER:
                said = name.replace("_", " ")
                raise InputError(f"{said} is {value}: it must be from {least} to {_MAX_NUMBER}")
        if not 0 < self.learning_rate <= _MAX_LEARNING_RATE:
            raise InputError(
                f"learning rate is {self.learning_rate}: it must be above 0 and at most "
                f"{_MAX_LEARNING_RATE}"
            )
        if not 0 <= self.noise < math.inf:
            raise InputError(f"noise is {self.noise}: it must be at least 0, and finite")


def default_batch_size(rows: int) -> int:
    """Rows in a batch where the settings leave it open, for that many training rows.

    The largest power of two that leaves at least 400 batches in an epoch, but at least 128 and at
    most 8192: the paper's size, and what its 4 million training rows get.
    """
    largest = 1 << max(1, rows // _BATCHES).bit_length() - 1
    return min(max(largest, _MIN_BATCH), _MAX_BATCH)


class Rows(Protocol):
    """Scaled rows (n, d): a tensor, or what gives chosen rows as one."""

    @property
    def shape(self) -> Sequence[int]:
        """(n, d)."""

    @property
    def device(self) -> torch.device:
        """Where the chosen rows will be."""

    def index_select(self, dim: int, index: Tensor, /) -> Tensor:
        """The rows with those numbers, in that order; `dim` is 0."""


class Epoch(NamedTuple):
    """The losses of an epoch: mean squared errors, of features scaled to [-1, 1]."""

    train_loss: float  # mean over the epoch, from corrupted rows
    test_loss: float  # after the epoch, from clean held-out rows


def get_device(name: str) -> torch.device:
    """The device cpu or cuda; auto is a GPU if there is one.

    Raises:
        InputError: another name, or there is no GPU.
    """
    gpu = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if gpu else "cpu")
    if name not in ("cpu", "cuda") or (name == "cuda" and not gpu):
        choices = "auto, cpu or cuda" if gpu else "auto or cpu"
        raise InputError(f"no device {name!r} on this machine: choose {choices}")
    return torch.device(name)


class Trainer:
    """Trains an autoencoder, an epoch at a time.

    An epoch's order and noise depend on the seed and the epoch's number alone, so that a resumed
    training gives the same weights as one that was never stopped.

    Args:
        training: its settings.
        train: scaled rows to train on, (n, d), on the device to train on.
        test: scaled rows to report the loss on, (m, d), on the same device.
        pool: bytes of rows that are shuffled together; see `jbrep.dae.order.shuffled`.

    Attributes:
        network: after the last epoch.
        optimiser: after the last epoch.
        best: parameters after the epoch with the lowest training loss; held-out rows have no
            influence on the choice.
        history: the epochs so far.

    Raises:
        InputError: there is no latent size.
    """

    def __init__(self, training: Training, train: Rows, test: Tensor, pool: int = POOL):
        if training.latent is None:
            raise InputError("an autoencoder needs a latent size")
        self.training = training
        self._train, self._test = train, test
        architecture = get_architecture(training.architecture)
        count, features = train.shape
        self._pool = pool // (features * test.element_size())  # rows
        network = Autoencoder(architecture, features, training.latent, training.seed)
        self.network = network.to(train.device)
        self.best = _copy(self.network)
        modules = (*self.network.encoder, *self.network.decoder)
        self._batch_size = min(training.batch_size or default_batch_size(count), count)
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
        """Train to the end, yielding each epoch."""
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
        train_loss = float(total) / self._train.shape[0]
        with torch.no_grad():
            test_loss = float(mse_loss(self.network(self._test), self._test))
        if not math.isfinite(train_loss) or not math.isfinite(test_loss):
            raise InputError(
                f"training diverged in epoch {number}, with losses {train_loss} and {test_loss}: "
                f"use less noise than {self.training.noise}, or a learning rate below "
                f"{self.training.learning_rate}"
            )
        if all(train_loss < epoch.train_loss for epoch in self.history):
            self.best = _copy(self.network)
        self.history.append(Epoch(train_loss, test_loss))

    def _learning_rate(self, number: int, batch: int) -> float:
        if not self._decay:
            return self.training.learning_rate
        batches = -(-self._train.shape[0] // self._batch_size)
        done = (number - 1 + batch / batches) / self.training.epochs
        return self.training.learning_rate * (1 + math.cos(math.pi * done)) / 2

    def _batches(self, number: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Every row once, clean and with independent noise on each feature, (d, rows) each."""
        size = self._batch_size
        for clean, corrupted in prefetch(self._draws(number)):
            yield from zip(clean.split(size, 1), corrupted.split(size, 1), strict=True)

    def _draws(self, number: int) -> Iterator[tuple[Tensor, Tensor]]:
        """The same, several batches at a time."""
        rows, noise = self._train, self.training.noise
        words = np.random.SeedSequence((self.training.seed, number)).generate_state(1, np.uint64)
        generator = torch.Generator(rows.device).manual_seed(int(words[0]))
        order = shuffled(rows.shape[0], self._pool, generator)
        for batches in order.split(_DRAWN_AT_ONCE * self._batch_size):
            clean = rows.index_select(0, batches).T.contiguous()
            if noise:
                drawn = torch.empty_like(clean).normal_(0, noise, generator=generator)
                yield clean, drawn.add_(clean)
            else:
                yield clean, clean


def _copy(network: Autoencoder) -> dict[str, Tensor]:
    return {name: p.clone() for name, p in network.state_dict().items()}


def prefetch(items: Iterable[_Item]) -> Iterator[_Item]:
    """The items in order, each produced in another thread while the one before it is used."""
    iterator = iter(items)
    with ThreadPoolExecutor(1) as executor:
        upcoming = executor.submit(next, iterator, None)
        while (item := upcoming.result()) is not None:
            upcoming = executor.submit(next, iterator, None)
            yield item


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Limit torch to one thread: more gain little with small networks and change the last bits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
