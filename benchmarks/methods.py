"""Every method that makes encoders: its time for a million rows, and what plain PyTorch takes.

python benchmarks/methods.py; a closed form makes a whole encoder, a learned one trains an epoch.
Ratios are medians over rounds taken in turn, so that a machine that slows down slows both sides.
"""

import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rows import make_rows
from timing import show, timed
from torch.utils.data import DataLoader
from torch.utils.data import Dataset as Mapped

from jbrep.dataset import ScaledDataset
from jbrep.methods.registry import METHODS
from jbrep.training.method import ClosedForm, Learned, Method
from jbrep.training.objective import Objective
from jbrep.training.trainer import Trainer, default_batch_size
from jbrep.training.windows import Windows, watched_windows

TASK = "face_direction"
EPISODE = 1000  # steps
ROWS = 250_000  # of which 80 % are trained on; all times are scaled to a million
MILLION = 1_000_000
USUAL_ROWS = 20_000  # that plain PyTorch goes through
REQUIRED_ONES = {"latent": 8, "features": "velocity_*"}
ADDING = {"noise": 32, "ofe": 32}  # latent sizes of the methods that add numbers to the observation
ROUNDS = 3


def make_data(folder: Path) -> ScaledDataset:
    """Rows in which each number wanders."""
    random = np.random.default_rng(0)

    def draw(name: str, shape: tuple[int, ...]) -> np.ndarray:
        values = random.uniform(-1, 1, shape)
        return np.cumsum(values, axis=0) % 2 - 1 if name == "observation" else values

    return ScaledDataset(make_rows(folder, TASK, ROWS, draw))


class UsualWindows(Mapped[Any]):
    """Windows as tutorials give them to a DataLoader: one at a time."""

    def __init__(self, data: ScaledDataset, horizons: tuple[int, ...], count: int):
        rows = data.train[: count + EPISODE]
        self._rows = torch.from_numpy(data.load(rows))
        self._actions = torch.from_numpy(data.dataset["action"][rows])
        self._rewards = torch.from_numpy(data.dataset["reward"][rows])
        self._ahead, self._horizon = torch.tensor(horizons), max(horizons, default=0)
        starts = np.arange(len(rows))
        self._starts = starts[starts % EPISODE < EPISODE - self._horizon][:count]

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, number: int) -> tuple[torch.Tensor, ...]:
        start = self._starts[number]
        if not self._horizon:
            return (self._rows[start],)
        end = start + self._horizon
        later = self._rows[start + self._ahead]
        return self._rows[start], later, self._actions[start:end], self._rewards[start:end]


def usual_epoch(objective: Objective, batches: Iterable[Any], ready: Any) -> None:
    """The same loss by autograd, once for each batch.

    Its targets are those of a batch that is ready: making them would cost it still more.
    """
    optimiser = torch.optim.Adam(objective.parameters(), 1e-3)
    for _ in batches:
        optimiser.zero_grad()
        objective.loss(ready).backward()
        optimiser.step()


def usual(method: type[Method]) -> Method:
    """The method with its defaults, and what has to be given."""
    given = {name: value for name, value in REQUIRED_ONES.items() if method.takes(name)}
    return method.of(given | ({"latent": ADDING[method.name]} if method.name in ADDING else {}))


def compare(name: str, method: Learned, data: ScaledDataset) -> None:
    """An epoch of ours against the usual one, for a million rows each, and what bounds both."""
    objective = method.objective(data)
    horizon = objective.horizon
    windows = Windows(data, data.train, horizon)
    size = method.batch_size or default_batch_size(MILLION)
    schedule = method.replace(epochs=ROUNDS + 1, batch_size=size, learning_rate=1e-3)
    watched = watched_windows(data, horizon, torch.device("cpu"))
    epochs = Trainer(objective, schedule, windows, watched).epochs()
    next(epochs)  # loads the rows
    horizons = getattr(method, "horizons", (1,)) if horizon else ()
    usual = UsualWindows(data, horizons, USUAL_ROWS // size * size)
    ready = objective.batch(windows, windows.numbers[:size])
    batches = DataLoader(usual, size, shuffle=True, drop_last=True)
    ours, ratios, bounds = [], [], []
    for _ in range(ROUNDS):
        ours.append(timed(partial(next, epochs)) / len(windows))
        theirs, bound = (
            timed(partial(usual_epoch, objective, each, ready)) / len(usual)
            for each in (batches, range(len(batches)))
        )
        ratios.append(theirs / ours[-1])
        bounds.append(theirs / bound)
    show(f"{name}: an epoch of a million rows [s]", [MILLION * seconds for seconds in ours])
    show(f"{name}: DataLoader's time / ours", ratios, "aim 15")
    show(f"{name}: DataLoader's time / that of batches that are ready", bounds)


def measure(name: str, method: ClosedForm, data: ScaledDataset) -> None:
    """The making of an encoder from a million rows."""
    method.check_data(data)
    unread = [ScaledDataset(data.dataset) for _ in range(ROUNDS)]  # which keep no moments yet
    seconds = [timed(partial(method.make, each)) for each in unread]
    show(f"{name}: made from a million rows [s]", MILLION / len(data.train) * np.array(seconds))


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        data = make_data(Path(folder) / "rows")
        for name, method in METHODS.items():
            match usual(method):
                case ClosedForm() as closed:
                    measure(name, closed.resolved(data), data)
                case Learned() as learned:
                    compare(name, learned, data)


if __name__ == "__main__":
    main()
