"""The forward code: what a network needs, beside the actions, to predict what comes next."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from jbrep.dae.network import check_size, get_architecture, layers, stack
from jbrep.dataset import ScaledDataset
from jbrep.errors import InputError
from jbrep.methods.linear_forward import turns
from jbrep.methods.method import Learned, Settings
from jbrep.methods.settings import REQUIRED
from jbrep.training.objective import Layers, Objective
from jbrep.training.windows import Windows

_HIDDEN = 128  # units of each of the two hidden layers of a predictor
_FITTED = 200_000  # windows to which targets are standardised
_SMALL = 1e-6  # standard deviation of a target that says nothing


class Forward(Objective):
    """Predictions from the code and the actions, at several horizons, and of actions from codes.

    At each horizon k a network of its own takes the code and the next k actions, and gives the
    change of each number of the row over k steps, its value then, and the mean reward until then,
    all standardised. The loss is the sum of their weighted mean squared errors, meant over the
    horizons, and of that of the first action from the codes of now and of the next step.

    Args:
        data: scaled.
        settings: of the method.
    """

    _turn: Tensor
    _weight: Tensor
    _mean: Tensor
    _deviation: Tensor

    def __init__(self, data: ScaledDataset, settings: Settings):
        super().__init__()
        self._horizons: tuple[int, ...] = settings["horizons"]
        self.horizon = max(self._horizons)
        architecture = get_architecture(settings["architecture"])
        size, latent, actions = data.size, settings["latent"], data.task.action_size
        parts = {"changes": size, "values": size, "reward": 1}
        self._parts = list(parts.values())
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(settings["seed"])
            self.encoder = stack((size, *architecture.hidden, latent), architecture.code)
            self.predictors = nn.ModuleList(
                stack((latent + k * actions, _HIDDEN, _HIDDEN, sum(parts.values())), "linear")
                for k in self._horizons
            )
            self._inverse_weight = settings["inverse"]
            self.inverse = stack((2 * latent, _HIDDEN, actions), "linear")
        weight = torch.cat([torch.full((n,), settings[name] / n) for name, n in parts.items()])
        scales = torch.zeros(len(self._horizons), len(weight)), torch.ones(len(self._horizons), 1)
        self.register_buffer("_turn", torch.from_numpy(turns(data)).float(), persistent=False)
        self.register_buffer("_weight", weight, persistent=False)
        self.register_buffer("_mean", scales[0], persistent=False)
        self.register_buffer("_deviation", scales[1], persistent=False)

    def prepare(self, windows: Windows) -> None:
        """Fit the standardisation of the targets."""
        step = -(-len(windows) // _FITTED)
        numbers = windows.numbers[::step]
        now = windows.rows(numbers)
        targets = [self._targets(windows, numbers, now, k) for k in self._horizons]
        self._mean = torch.stack([each.mean(0) for each in targets])
        deviation = torch.stack([each.std(0) for each in targets])
        self._deviation = torch.where(deviation > _SMALL, deviation, math.inf)

    def _targets(self, windows: Windows, numbers: Tensor, now: Tensor, ahead: int) -> Tensor:
        """Changes, values and mean reward at a horizon, (n, 2 * size + 1)."""
        then = windows.rows(numbers, ahead)
        change = then - now
        half = self._turn / 2  # infinite for what is no angle
        wrapped = torch.remainder(change + half, self._turn) - half
        change = torch.where(torch.isfinite(half), wrapped, change)
        return torch.cat((change, then, windows.rewards(numbers, ahead)[:, None]), 1)

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        """Rows, the next ones, all actions, and the standardised targets of each horizon."""
        now = windows.rows(numbers)
        targets = [self._targets(windows, numbers, now, k) for k in self._horizons]
        standard = (torch.stack(targets, 1) - self._mean) / self._deviation
        actions = windows.actions(numbers, self.horizon).flatten(1)
        return now, windows.rows(numbers, 1), actions, standard

    def _errors(self, batch: tuple[Tensor, ...]) -> Tensor:
        """Squared errors, meant over rows, (horizons, targets)."""
        now, _, actions, targets = batch
        code = self.encoder(now)
        width = actions.shape[1] // self.horizon
        errors = []
        for i, (ahead, predictor) in enumerate(zip(self._horizons, self.predictors, strict=True)):
            predicted = predictor(torch.cat((code, actions[:, : ahead * width]), 1))
            errors.append((predicted - targets[:, i]).square().mean(0))
        return torch.stack(errors)

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        """As for `Objective`."""
        loss = (self._errors(batch) @ self._weight).mean()
        if self._inverse_weight:
            now, after, actions, _ = batch
            both = torch.cat((self.encoder(now), self.encoder(after)), 1)
            error = self.inverse(both) - actions[:, : actions.shape[1] // self.horizon]
            loss = loss + self._inverse_weight * error.square().mean()
        return loss

    def layers(self) -> tuple[Layers, Layers | None]:
        """As for `Objective`; there is no decoder."""
        return layers(self.encoder), None

    def report(self, windows: Windows) -> dict[str, Any]:
        """The loss by horizon: of changes, values and reward, unweighted; 1 for no prediction."""
        errors = self._errors(self.batch(windows, windows.numbers))
        by_part = [part.mean(1).tolist() for part in errors.split(self._parts, 1)]
        names = ("changes", "values", "reward")
        return {
            "loss_by_horizon": {
                str(k): dict(zip(names, losses, strict=True))
                for k, losses in zip(self._horizons, zip(*by_part, strict=True), strict=True)
            }
        }


def _check(data: ScaledDataset, settings: Settings) -> None:
    check_size(get_architecture(settings["architecture"]), data.size, settings["latent"])
    if not any(settings[name] for name in ("changes", "values", "reward")):
        raise InputError("forward has nothing to predict: all its weights are 0")


METHOD = Learned(
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
