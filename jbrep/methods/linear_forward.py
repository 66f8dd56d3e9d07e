"""The linear forward code: what now says, beyond the actions, of what comes next."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta

from jbrep.coordinates import wrapped
from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.envs.task import Array
from jbrep.errors import InputError
from jbrep.methods.linear import Directions, direction_code, whitening
from jbrep.methods.passes import blocks, check_enough
from jbrep.training.method import Made
from jbrep.training.settings import RewardWeight, Steps, Weight

_NEGLIGIBLE = 1e-12  # variance of a target that says nothing
_NO_RANK = 1e-9  # singular value, as a share of the largest

PARTS = ("changes", "values", "reward")  # of the targets at a horizon, in their order

Horizons = Annotated[Steps, Meta(description="Steps ahead that are predicted, one or several.")]
ChangesWeight = Annotated[Weight, Meta(description="Weight of all changes of features.")]
ValuesWeight = Annotated[Weight, Meta(description="Weight of all future values of features.")]


class LinearForward(Directions, frozen=True, kw_only=True):
    """Linear forward code: what the row says, beyond the actions, of what comes next.

    It is reduced-rank regression of that on the row and the actions (Izenman 1975; predictive
    states: Littman et al. 2001). Targets, at each horizon k: the change of each number over k
    steps, its value then, and the mean reward until then. Changes and values are brought to a
    variance of their weights, the reward to its weight times the numbers in a row: at equal weights
    it counts as much as all changes together. They are regressed on the centred row x and the next
    actions together; B is the block of coefficients of the row, C its covariance. The code is U'
    C^(-1/2) (x - mean), of the first left singular vectors U of C^(1/2) B; its units have standard
    deviation 1/3. The spectrum is that of the singular values.

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

    @classmethod
    def achieved(cls, metrics: Mapping[str, Any], latent: int) -> str:
        explained = [each**2 for each in metrics["spectrum"]]
        share = sum(explained[:latent]) / sum(explained)
        return f"keeps {share:.0%} of what a linear code can tell of what comes next"

    def make(self, data: ScaledDataset) -> Made:
        size = data.size
        moments, shared, variances = _moments(data, self.horizons)
        weights = self._scales(data)
        varies = variances > _NEGLIGIBLE
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
        """The standard deviation that each target is brought to, (t,)."""
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
