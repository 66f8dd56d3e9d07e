"""Forward codes: what is needed, beside the actions, to predict what comes next.

One by reduced-rank regression, one by a network.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor, nn

from jbrep.coordinates import wrapped
from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.envs.task import Array
from jbrep.errors import InputError
from jbrep.methods.linear import Directions, direction_code, whitening
from jbrep.methods.passes import blocks, check_enough
from jbrep.training.method import Learned, Made, Network
from jbrep.training.network import HIDDEN, get_architecture, seeded, stack
from jbrep.training.objective import Objective
from jbrep.training.settings import Architecture, Codes, RewardWeight, Steps, Weight
from jbrep.training.windows import Windows

_NO_RANK = 1e-9  # singular value, as a share of the largest

PARTS = ("changes", "values", "reward")  # of the targets at a horizon, in their order

Horizons = Annotated[Steps, Meta(description="Steps ahead that are predicted, one or several.")]
ChangesWeight = Annotated[Weight, Meta(description="Weight of all changes of features.")]
ValuesWeight = Annotated[Weight, Meta(description="Weight of all future values of features.")]

_FITTED = 200_000  # windows to which targets are standardised
_FITTED_NUMBERS = 1 << 26  # at most in these targets: 256 MiB
_SMALL = 1e-6  # standard deviation of a target that says nothing


class LinearForward(Directions, frozen=True, kw_only=True):
    """The linear latent that best predicts what comes next, given the actions.

    It is reduced-rank regression of that on the row and the actions (Izenman 1975; predictive
    states: Littman et al. 2001). Targets, at each horizon k: the change of each number over k
    steps, its value then, and the mean reward until then. Changes and values are brought to a
    variance of their weights, the reward to its weight times the numbers in a row: at equal weights
    it counts as much as all changes together. They are regressed on the centred row x and the next
    actions together; B is the block of coefficients of the row, C its covariance. The code is U'
    C^(-1/2) (x - mean), of the first left singular vectors U of C^(1/2) B; its units have standard
    deviation 1/3. The spectrum is that of the singular values.

    Where actions follow from the state, those after a horizon tell of it: the code isn't the best.
    It takes one pass over the windows; over a sample of them where rows are wide, see `blocks`.
    """

    name: ClassVar[str] = "linear-forward"

    horizons: Horizons = (1, 5, 10, 20)
    changes: ChangesWeight = 1.0
    values: ValuesWeight = 1.0
    reward: RewardWeight = 1.0

    def check_data(self, data: ScaledDataset) -> None:
        super().check_data(data)
        check_targets(data, self.name, weights_of(self))

    def make(self, data: ScaledDataset) -> Made:
        size = data.size
        moments, shared, variances = _moments(data, self.horizons)
        weights = self._scales(data)
        varies = variances > _SMALL**2
        scale = np.where(varies, weights / np.sqrt(np.where(varies, variances, 1)), 0)
        if not scale.any():
            raise nothing_varies(data, self.name)
        coefficients = np.linalg.lstsq(moments.covariance, shared * scale, rcond=None)[0]
        here = Moments(moments.mean[:size], moments.covariance[:size, :size])
        whiten = whitening(here.covariance, data)
        left, singular, _ = np.linalg.svd(
            whiten @ here.covariance @ coefficients[:size], full_matrices=False
        )
        rank = int((singular > _NO_RANK * singular[0]).sum())
        if self.latent > rank:
            raise InputError(
                f"latent size is {self.latent}: what linear-forward is to predict has rank "
                f"{rank} in {data.dataset.folder}, so it must be from 1 to {rank}"
            )
        return direction_code(left[:, : self.latent].T @ whiten, here, singular)

    def _scales(self, data: ScaledDataset) -> Array:
        sizes = data.size, data.size, 1
        once = [
            np.full(n, np.sqrt(weight * data.size / n))
            for n, weight in zip(sizes, weights_of(self).values(), strict=True)
        ]
        return np.tile(np.concatenate(once), len(self.horizons))


def _moments(data: ScaledDataset, horizons: tuple[int, ...]) -> tuple[Moments, Array, Array]:
    """Moments of rows with actions (p,), their covariances with targets, (p, t), and variances.

    The variances are those of the targets, (t,).
    """
    size, longest, turn = data.size, max(horizons), turns(data)
    actions = longest * data.task.action_size
    regressors, targets = size + actions, len(horizons) * (2 * size + 1)
    count, width = 0, regressors + targets
    total, squares = np.zeros(width), np.zeros(targets)
    products = np.zeros((regressors, width))
    for block in blocks(data, longest, width, regressors * width):
        now = block.later(0)
        columns = [now, block.next_actions(longest)]
        for ahead in horizons:
            then = block.later(ahead)
            columns += [change(now, then, turn), then, block.mean_reward(ahead)]
        values = np.hstack(columns)
        count += len(block)
        total += values.sum(axis=0)
        products += values[:, :regressors].T @ values
        squares += np.einsum("mt,mt->t", values[:, regressors:], values[:, regressors:])
    check_enough(count, regressors, data, longest, "smaller horizons")
    mean = total / count
    covariance = products / count - np.outer(mean[:regressors], mean)
    moments = Moments(mean[:regressors], covariance[:, :regressors])
    return moments, covariance[:, regressors:], squares / count - mean[regressors:] ** 2


def weights_of(method: Any) -> dict[str, float]:
    """The weights of a method's targets at a horizon."""
    return {part: getattr(method, part) for part in PARTS}


def check_targets(data: ScaledDataset, kind: str, weights: Mapping[str, float]) -> None:
    """Make sure that a kind of method has something to predict, with these weights of targets."""
    weighted = [name for name, weight in weights.items() if weight]
    if not weighted or (weighted == ["reward"] and not data.reward_varies):
        raise nothing_varies(data, kind)


def nothing_varies(data: ScaledDataset, kind: str) -> InputError:
    """The mistake of predicting what is constant."""
    return InputError(
        f"nothing that {kind} is to predict varies in {data.dataset.folder}: give other targets a "
        "weight above 0"
    )


def turns(data: ScaledDataset) -> Array:
    """The length of a full turn of each scaled number that is an angle, (size,); else infinite."""
    turn = [2 * math.pi if each.is_full_turn else math.inf for each in data.features]
    return np.array(turn) / data.scaler.half_width[data.used]


def change(now: Array, then: Array, turn: Array) -> Array:
    """What scaled rows change by, (m, size); angles take the shorter way."""
    difference = then - now
    angles = np.isfinite(turn)
    unit = turn[angles] / (2 * math.pi)
    difference[:, angles] = wrapped(difference[:, angles] / unit) * unit
    return difference


class Forward(Network, Learned, frozen=True, kw_only=True):
    """Latent of a network that predicts changes and rewards to come, given the actions.

    S-RL Toolbox, Raffin et al. 2018; OFENet, Ota et al. 2020. The scale of a code says nothing to
    its predictors, so it is made standard.
    """

    name: ClassVar[str] = "forward"

    architecture: Architecture = "deep"
    codes: Codes = "standard"
    horizons: Horizons = (1, 5, 10, 20)
    changes: ChangesWeight = 1.0
    values: ValuesWeight = 1.0
    reward: RewardWeight = 1.0
    inverse: Annotated[Weight, Meta(description="Weight of the action, from both latents.")] = 0.0

    def check_data(self, data: ScaledDataset) -> None:
        super().check_data(data)
        check_targets(data, self.name, {**weights_of(self), "inverse": self.inverse})

    def objective(self, data: ScaledDataset) -> Objective:
        return ForwardObjective(self, data)


class _Batch(NamedTuple):
    """Windows, features first."""

    now: Tensor  # first rows, (size, n)
    after: Tensor  # the rows of the next step, (size, n)
    actions: Tensor  # all of a window, step by step, (horizon * k, n)
    targets: Tensor  # standardised, (horizons, 2 * size + 1, n)


class Predictors(nn.Module):
    """Networks of one shape, of which each reads the first so many of some shared inputs.

    Each has two hidden layers of ReLU. Features come first and rows last, and all networks are
    multiplied at once: with so few units, a step of separate ones is bound by calls and by memory.
    """

    _read: Tensor

    def __init__(self, reads: tuple[int, ...], outputs: int):
        super().__init__()
        count, most = len(reads), max(reads)
        fan_in = torch.tensor(reads), *(torch.full((count,), HIDDEN) for _ in range(2))
        shapes = (HIDDEN, most), (HIDDEN, HIDDEN), (outputs, HIDDEN)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for (width, inputs), fan in zip(shapes, fan_in, strict=True):
            limit = fan.rsqrt()[:, None, None]  # as nn.Linear
            self.weights.append((2 * torch.rand(count, width, inputs) - 1) * limit)
            self.biases.append((2 * torch.rand(count, width, 1) - 1) * limit)
        read = torch.arange(most) < torch.tensor(reads)[:, None, None]
        self.register_buffer("_read", read.float(), persistent=False)

    def forward(self, inputs: Tensor) -> Tensor:
        """What each network gives, (networks, outputs, n), of inputs (most, n)."""
        first = (self.weights[0] * self._read).flatten(0, 1)
        hidden = torch.addmm(self.biases[0].flatten(0, 1), first, inputs).relu_()
        hidden = hidden.view(len(self._read), HIDDEN, -1)
        hidden = torch.baddbmm(self.biases[1], self.weights[1], hidden).relu_()
        return torch.baddbmm(self.biases[2], self.weights[2], hidden)


class ForwardObjective(Objective):
    """Predictions from the code and the actions, at several horizons, and of actions from codes.

    At each horizon k a network of its own takes the code and the next k actions, and gives the
    change of each number of the row over k steps, its value then, and the mean reward until then,
    all standardised. The loss is the sum of their weighted mean squared errors, averaged over the
    horizons, and of that of the first action from the codes of now and of the next step.

    Units of the code are linear, whatever the architecture: with tanh, some saturate early in the
    training and stay constant.
    """

    _turn: Tensor
    _turns_per: Tensor
    _weight: Tensor
    _mean: Tensor
    _deviation: Tensor

    def __init__(self, method: Forward, data: ScaledDataset):
        super().__init__()
        self._horizons = method.horizons
        self.horizon = max(self._horizons)
        hidden = get_architecture(method.architecture).hidden
        size, latent = data.size, method.latent
        self._action_size, self._sizes = data.task.action_size, (size, size, 1)
        reads = tuple(latent + k * self._action_size for k in self._horizons)
        self._inverse_weight = method.inverse
        with seeded(method.seed):
            self.encoder = stack((size, *hidden, latent), "linear")
            self.predictors = Predictors(reads, sum(self._sizes))
            if self._inverse_weight:
                self.inverse = stack((2 * latent, HIDDEN, self._action_size), "linear")
        each = [w / n for w, n in zip(weights_of(method).values(), self._sizes, strict=True)]
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
        of_each = len(self._horizons) * sum(self._sizes)
        step = -(-len(windows) // min(_FITTED, max(1, _FITTED_NUMBERS // of_each)))
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
        parts = (part.split(size, -1) for part in self.batch(windows, numbers))
        yield from map(_Batch, *parts)

    def _errors(self, batch: _Batch, code: Tensor) -> Tensor:
        predicted = self.predictors(torch.cat((code.T, batch.actions)))
        return (predicted - batch.targets).square().mean(2)

    def loss(self, batch: _Batch) -> Tensor:
        code = self.encoder(batch.now.T)
        loss = (self._errors(batch, code) @ self._weight).mean()
        if self._inverse_weight:
            said = self.inverse(torch.cat((code, self.encoder(batch.after.T)), 1))
            error = said.T - batch.actions[: self._action_size]
            loss = loss + self._inverse_weight * error.square().mean()
        return loss

    def report(self, windows: Windows) -> dict[str, Any]:
        """The loss by horizon: of changes, values and reward, unweighted; 1 for no prediction.

        Of those that have a weight and vary: there may be no reward.
        """
        batch = self.batch(windows, windows.numbers)
        errors = self._errors(batch, self.encoder(batch.now.T))
        counts = self._deviation.squeeze(2).isfinite() & (self._weight > 0)
        each = zip(PARTS, *(of.split(self._sizes, 1) for of in (errors, counts)), strict=True)
        by_part = {
            part: lost[:, some.any(0)].mean(1).tolist() for part, lost, some in each if some.any()
        }
        return {
            "loss_by_horizon": {
                str(k): {part: losses[i] for part, losses in by_part.items()}
                for i, k in enumerate(self._horizons)
            }
        }
