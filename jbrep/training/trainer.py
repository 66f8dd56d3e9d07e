"""Training any objective: batches, epochs, and checkpoints, which run nothing when read."""

import math
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor
from torch.optim import Adam, Optimizer

from jbrep.errors import InputError, differences
from jbrep.progress import Progress
from jbrep.records import container
from jbrep.records.record import Finite, Record, from_plain, to_plain
from jbrep.training.objective import Objective
from jbrep.training.windows import Windows

if TYPE_CHECKING:
    from jbrep.training.method import Learned

_MIN_BATCH, _MAX_BATCH = 128, 8192
_BATCHES = 400  # that an epoch should have
_DRAWN_AT_ONCE = 4  # batches
_Item = TypeVar("_Item")


def default_batch_size(rows: int) -> int:
    """Rows in a batch where the settings leave it open, for that many training rows.

    The largest power of two that leaves at least 400 batches in an epoch, but at least 128 and at
    most 8192: the paper's size, and what its 4 million training rows get.
    """
    largest = 1 << max(1, rows // _BATCHES).bit_length() - 1
    return min(max(largest, _MIN_BATCH), _MAX_BATCH)


class Epoch(NamedTuple):
    """The losses of an epoch, as its objective defines them."""

    train_loss: Finite  # mean over the epoch, of parameters as they were then, with noise
    test_loss: Finite  # after the epoch, from clean held-out rows


class Schedule(NamedTuple):
    """How long to train, and how."""

    epochs: int
    batch_size: int | None
    learning_rate: float
    seed: int


class _Checkpoint(Record, frozen=True, kw_only=True):
    identity: dict[str, Any]  # what must be equal for training to resume
    history: tuple[Epoch, ...]


def get_device(name: str) -> torch.device:
    """The device cpu or cuda; auto is a GPU if there is one."""
    gpu = torch.cuda.is_available()
    if name == "auto":
        return torch.device("cuda" if gpu else "cpu")
    if name not in ("cpu", "cuda") or (name == "cuda" and not gpu):
        choices = "auto, cpu or cuda" if gpu else "auto or cpu"
        raise InputError(f"no device {name!r} on this machine: choose {choices}")
    return torch.device(name)


class Trainer:
    """Trains an objective, which is on the windows' device, an epoch at a time.

    An epoch's order and noise depend on the seed and the epoch's number alone, so that a resumed
    training gives the same weights as one that was never stopped. The loss on `watched` windows is
    reported.

    Attributes:
        objective, optimiser: after the last epoch.
        best: parameters after the epoch that the objective's `kept_by` names.
        history: the epochs so far.
    """

    def __init__(
        self,
        objective: Objective,
        schedule: "Learned | Schedule",
        windows: Windows,
        watched: Windows,
    ):
        self.objective, self.schedule = objective, schedule
        self._windows = windows
        count = len(windows)
        self._batch_size = min(schedule.batch_size or default_batch_size(count), count)
        self._batches_per_epoch = -(-count // self._batch_size)
        objective.prepare(windows)
        self._watched = objective.batch(watched, watched.numbers)
        self.best = _copy(objective)
        self.optimiser = Adam(objective.parameters(), schedule.learning_rate, fused=True)
        allocate_adam_state(self.optimiser)
        self.history: list[Epoch] = []

    @property
    def best_epoch(self) -> int:
        """The epoch whose parameters are kept, from 1; 0 before the first."""
        kept_by = self.objective.kept_by
        if kept_by is None or not self.history:
            return len(self.history)
        losses = [getattr(epoch, kept_by) for epoch in self.history]
        return losses.index(min(losses)) + 1

    def epochs(self, patience: int | None = None) -> Iterator[Epoch]:
        """Train to the end, or until `patience` epochs bring no improvement, yielding each."""
        with single_torch_thread():
            while len(self.history) < self.schedule.epochs:
                if patience and len(self.history) - self.best_epoch >= patience:
                    return
                self._epoch()
                yield self.history[-1]

    def with_progress(self, name: str, patience: int | None = None) -> Iterator[Epoch]:
        """The epochs, with a progress bar."""
        total, done = self.schedule.epochs, len(self.history)
        with Progress(total=total, initial=done, desc=name, unit="epoch") as progress:
            for epoch in self.epochs(patience):
                progress.set_postfix(train=f"{epoch.train_loss:.5f}", test=f"{epoch.test_loss:.5f}")
                progress.update()
                yield epoch

    def save(self, identity: Mapping[str, Any], path: Path) -> None:
        """Write the state after an epoch, with what must be equal to resume it, as plain JSON."""
        tensors = {name: tensor.cpu().numpy() for name, tensor in self._state.items()}
        header = _Checkpoint(identity=dict(identity), history=tuple(self.history))
        container.write(path, tensors, to_plain(header))

    def restore(self, identity: Mapping[str, Any], path: Path) -> None:
        """Go on from the state that a file holds."""
        tensors, header = container.read(path, "checkpoint")
        saved, state = from_plain(header, _Checkpoint), self._state
        if differing := differences(saved.identity, identity):
            raise InputError(
                f"{path} belongs to another configuration: {differing}; choose another folder, or "
                "delete it to start over"
            )
        for name, tensor in state.items():
            tensor.copy_(torch.from_numpy(tensors[name]))
        self.history = list(saved.history)

    @property
    def _state(self) -> dict[str, Tensor]:
        named = {f"network.{name}": p for name, p in self.objective.state_dict().items()}
        named |= {f"best.{name}": p for name, p in self.best.items()}
        for name, parameter in self.objective.named_parameters():
            moments = self.optimiser.state[parameter].items()
            named |= {f"adam.{name}.{key}": value for key, value in moments}
        return named

    def _epoch(self) -> None:
        number = len(self.history) + 1
        count = len(self._windows)
        total = torch.zeros((), device=self._windows.device)
        self.objective.train()
        for i, batch in enumerate(chain.from_iterable(prefetch(self._draws(number)))):
            self.optimiser.param_groups[0]["lr"] = self._learning_rate(number, i)
            rows = min(self._batch_size, count - i * self._batch_size)
            total += self.objective.gradient(batch) * rows
            self.optimiser.step()
        self._record(number, float(total) / count, self._held_out_loss())

    def _held_out_loss(self) -> float:
        self.objective.eval()
        with torch.no_grad():
            return float(self.objective.loss(self._watched))

    def _record(self, number: int, train_loss: float, test_loss: float) -> None:
        if not math.isfinite(train_loss) or not math.isfinite(test_loss):
            raise InputError(
                f"training diverged in epoch {number}, with losses {train_loss} and {test_loss}: "
                f"use a learning rate below {self.schedule.learning_rate}, or less noise if there "
                "is some"
            )
        self.history.append(Epoch(train_loss, test_loss))
        if self.best_epoch == number:
            self.best = _copy(self.objective)

    def _learning_rate(self, number: int, batch: int) -> float:
        step = (number - 1) * self._batches_per_epoch + batch
        progress = step / (self._batches_per_epoch * self.schedule.epochs)
        return self.schedule.learning_rate * self.objective.rate(progress, step)

    def _draws(self, number: int) -> Iterator[list[Any]]:
        words = np.random.SeedSequence((self.schedule.seed, number)).generate_state(1, np.uint64)
        generator = torch.Generator(self._windows.device).manual_seed(int(words[0]))
        order = torch.randperm(len(self._windows), generator=generator, device=self._windows.device)
        for numbers in order.split(_DRAWN_AT_ONCE * self._batch_size):
            drawn = self.objective.draws(self._windows, numbers, self._batch_size, generator)
            yield list(drawn)


def _copy(objective: Objective) -> dict[str, Tensor]:
    return {name: p.clone() for name, p in objective.state_dict().items()}


def allocate_adam_state(optimizer: Optimizer) -> None:
    """Create now the state that Adam would create in its first step, for a checkpoint to fill."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            optimizer.state[parameter] = {
                "step": torch.zeros((), device=parameter.device),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }


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


@contextmanager
def single_thread() -> Iterator[None]:
    """Limit torch and what NumPy and SciPy compute with to one thread, for the same reasons."""
    with single_torch_thread(), threadpool_limits(1, "blas"):
        yield
