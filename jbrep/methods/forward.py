"""The forward code: what a network needs, beside the actions, to predict what comes next."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from jbrep.dae.network import check_size, get_architecture, layers, seeded, stack
from jbrep.dataset import ScaledDataset
from jbrep.methods.method import Learned, Settings
from jbrep.methods.predictors import HIDDEN, Predictors
from jbrep.methods.settings import REQUIRED, STANDARD
from jbrep.methods.targets import PARTS, check_targets, turns
from jbrep.training.objective import Layers, Objective
from jbrep.training.windows import Windows

_FITTED = 200_000  # windows to which targets are standardised
_SMALL = 1e-6  # standard deviation of a target that says nothing


class _Batch(NamedTuple):
    """Windows, features first."""

    now: Tensor  # first rows, (size, n)
    after: Tensor  # the rows of the next step, (size, n)
    actions: Tensor  # all of a window, step by step, (horizon * k, n)
    targets: Tensor  # standardised, (horizons, 2 * size + 1, n)


class Forward(Objective):
    """Predictions from the code and the actions, at several horizons, and of actions from codes.

    At each horizon k a network of its own takes the code and the next k actions, and gives the
    change of each number of the row over k steps, its value then, and the mean reward until then,
    all standardised. The loss is the sum of their weighted mean squared errors, meant over the
    horizons, and of that of the first action from the codes of now and of the next step.

    Units of the code are linear, whatever the architecture: with tanh, some saturate early in the
    training and stay constant.

    Args:
        data: scaled.
        settings: of the method.
    """

    _turn: Tensor
    _turns_per: Tensor
    _weight: Tensor
    _mean: Tensor
    _deviation: Tensor

    def __init__(self, data: ScaledDataset, settings: Settings):
        super().__init__()
        self._horizons: tuple[int, ...] = settings["horizons"]
        self.horizon = max(self._horizons)
        hidden = get_architecture(settings["architecture"]).hidden
        size, latent = data.size, settings["latent"]
        self._action_size, self._sizes = data.task.action_size, (size, size, 1)
        reads = tuple(latent + k * self._action_size for k in self._horizons)
        self._inverse_weight = settings["inverse"]
        with seeded(settings["seed"]):
            self.encoder = stack((size, *hidden, latent), "linear")
            self.predictors = Predictors(reads, sum(self._sizes))
            if self._inverse_weight:
                self.inverse = stack((2 * latent, HIDDEN, self._action_size), "linear")
        each = [settings[name] / n for name, n in zip(PARTS, self._sizes, strict=True)]
        turn = torch.from_numpy(turns(data)).float()[:, None]  # infinite for what is no angle
        for name, buffer in (
            ("_turn", turn.nan_to_num(posinf=0)),
            ("_turns_per", 1 / turn),
            ("_weight", torch.tensor(each).repeat_interleave(torch.tensor(self._sizes))),
            ("_mean", torch.zeros(())),
            ("_deviation", torch.ones(())),
        ):
            self.register_buffer(name, buffer, persistent=False)

    def prepare(self, windows: Windows) -> None:
        """Fit the standardisation of the targets."""
        step = -(-len(windows) // _FITTED)
        deviation, self._mean = torch.std_mean(
            self.batch(windows, windows.numbers[::step]).targets, 2, keepdim=True
        )
        self._deviation = torch.where(deviation > _SMALL, deviation, math.inf)

    def _targets(self, windows: Windows, numbers: Tensor, now: Tensor, ahead: int) -> Tensor:
        """Changes, values and mean reward at a horizon, (2 * size + 1, n)."""
        then = windows.rows(numbers, ahead).T
        change = then - now
        change -= torch.round(change * self._turns_per) * self._turn  # angles: the shorter way
        return torch.cat((change, then, windows.rewards(numbers, ahead)[None]))

    def batch(self, windows: Windows, numbers: Tensor) -> _Batch:
        """As for `Objective`, but with the windows last."""
        now = windows.rows(numbers).T.contiguous()
        targets = torch.stack([self._targets(windows, numbers, now, k) for k in self._horizons])
        return _Batch(
            now,
            windows.rows(numbers, 1).T.contiguous(),
            windows.actions(numbers, self.horizon).flatten(1).T.contiguous(),
            targets.sub_(self._mean).div_(self._deviation),
        )

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[_Batch]:
        """As for `Objective`."""
        parts = (part.split(size, -1) for part in self.batch(windows, numbers))
        yield from map(_Batch, *parts)

    def _errors(self, batch: _Batch, code: Tensor) -> Tensor:
        """Squared errors from codes (n, l), meant over rows, (horizons, targets)."""
        predicted = self.predictors(torch.cat((code.T, batch.actions)))
        return (predicted - batch.targets).square().mean(2)

    def loss(self, batch: _Batch) -> Tensor:
        """As for `Objective`."""
        code = self.encoder(batch.now.T)
        loss = (self._errors(batch, code) @ self._weight).mean()
        if self._inverse_weight:
            said = self.inverse(torch.cat((code, self.encoder(batch.after.T)), 1))
            error = said.T - batch.actions[: self._action_size]
            loss = loss + self._inverse_weight * error.square().mean()
        return loss

    def layers(self) -> tuple[Layers, Layers | None]:
        """As for `Objective`; there is no decoder."""
        return layers(self.encoder), None

    def report(self, windows: Windows) -> dict[str, Any]:
        """The loss by horizon: of changes, values and reward, unweighted; 1 for no prediction."""
        batch = self.batch(windows, windows.numbers)
        errors = self._errors(batch, self.encoder(batch.now.T))
        by_part = [part.mean(1).tolist() for part in errors.split(self._sizes, 1)]
        return {
            "loss_by_horizon": {
                str(k): dict(zip(PARTS, losses, strict=True))
                for k, losses in zip(self._horizons, zip(*by_part, strict=True), strict=True)
            }
        }


def _check(data: ScaledDataset, settings: Settings) -> None:
    check_size(settings["architecture"], data.size, settings["latent"])
    check_targets(data, settings, "forward", ("inverse",))


class _Forward(Learned):
    """The scale of a code says nothing to its predictors, so it is made standard."""

    def fill(self, given: Settings) -> dict[str, Any]:
        """As for `Method`."""
        return {**self.defaults, "codes": STANDARD}


METHOD = _Forward(
    name="forward",
    words="what a network needs, beside the actions, to predict changes and rewards to come",
    source="S-RL Toolbox, Raffin et al. 2018; OFENet, Ota et al. 2020",
    own={
        "latent": REQUIRED,
        "architecture": "deep",
        "horizons": (1, 5, 10, 20),
        "changes": 1.0,
        "values": 1.0,
        "reward": 1.0,
        "inverse": 0.0,
        "epochs": 12,
        "batch_size": None,
        "learning_rate": 2e-3,
        "seed": 0,
    },
    check=_check,
    objective=Forward,
)
