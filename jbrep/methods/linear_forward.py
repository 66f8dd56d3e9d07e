"""The linear forward code: what now says, beyond the actions, of what comes next."""

import math

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaling import wrapped
from jbrep.errors import InputError
from jbrep.methods.linear import DEVIATION, check_varying, dense, inverse_root, signed
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.passes import Array, Block, blocks
from jbrep.methods.settings import REQUIRED

_NEGLIGIBLE = 1e-12  # variance of a target that says nothing


def make(data: ScaledDataset, settings: Settings) -> Made:
    """Reduced-rank regression of what comes next on the row and the actions (Izenman 1975).

    Targets, at each horizon k: the change of each number over k steps, its value then, and the mean
    reward until then, each brought to a variance of its squared weight. They are regressed on the
    centred row x and the next actions together; B is the block of coefficients of the row, C its
    covariance. The code is U' C^(-1/2) (x - mean), of the first left singular vectors U of
    C^(1/2) B; its units have standard deviation 1/3.
    """
    horizons = settings["horizons"]
    size, actions = data.size, max(horizons) * data.task.action_size
    wide = _Targets(data, settings)
    mean, covariance = _moments(data, wide, max(horizons))
    regressors = slice(0, size + actions)
    targets = slice(size + actions, None)
    deviation = np.sqrt(np.diag(covariance)[targets])
    scale = np.where(deviation > _NEGLIGIBLE, wide.weights / np.maximum(deviation, _NEGLIGIBLE), 0)
    explained = covariance[regressors, targets] * scale
    coefficients = np.linalg.lstsq(covariance[regressors, regressors], explained, rcond=None)[0]
    here = covariance[:size, :size]
    root = inverse_root(here, f"the features of {data.dataset.folder}")
    left, singular, _ = np.linalg.svd(here @ root @ coefficients[:size])
    weight = DEVIATION * signed(left[:, : settings["latent"]].T @ root)
    metrics = {"spectrum": singular.tolist()}
    return Made((dense(weight, -weight @ mean[:size]),), None, metrics)


class _Targets:
    """Everything that is regressed, and regressed on, of a block of windows."""

    def __init__(self, data: ScaledDataset, settings: Settings):
        self.horizons = settings["horizons"]
        self._longest = max(self.horizons)
        parts = ("changes", data.size), ("values", data.size), ("reward", 1)
        once = np.concatenate([np.full(n, settings[name]) for name, n in parts])
        self.weights: Array = np.tile(once, len(self.horizons))
        self.width = data.size + self._longest * data.task.action_size + len(self.weights)
        self._turn = turns(data)

    def __call__(self, block: Block) -> Array:
        """Rows, actions and targets side by side, (m, width)."""
        now = block.later(0)
        columns = [now, block.next_actions(self._longest)]
        for ahead in self.horizons:
            then = block.later(ahead)
            columns += [change(now, then, self._turn), then, block.mean_reward(ahead)]
        return np.hstack(columns)


def turns(data: ScaledDataset) -> Array:
    """The length of a full turn of each scaled number that is an angle, (size,); else infinite."""
    coded = set(data.scaler.angles)
    whole = [
        2 * math.pi / data.scaler.half_width[i]
        if i < data.task.size and i not in coded and data.task.features[i].is_angle
        else math.inf
        for i in data.used
    ]
    return np.array(whole)


def change(now: Array, then: Array, turn: Array) -> Array:
    """What scaled rows change by, (m, size); angles take the shorter way."""
    difference = then - now
    angles = np.isfinite(turn)
    unit = turn[angles] / (2 * math.pi)
    difference[:, angles] = wrapped(difference[:, angles] / unit) * unit
    return difference


def _moments(data: ScaledDataset, wide: _Targets, horizon: int) -> tuple[Array, Array]:
    """Mean and covariance of all columns, over all windows of the training part."""
    count, total, products = 0, np.zeros(wide.width), np.zeros((wide.width, wide.width))
    for block in blocks(data, horizon, wide.width):
        values = wide(block)
        count += len(values)
        total += values.sum(axis=0)
        products += values.T @ values
    mean = total / count
    return mean, products / count - np.outer(mean, mean)


def _check(data: ScaledDataset, settings: Settings) -> None:
    check_varying(data, settings)
    if not any(settings[name] for name in ("changes", "values", "reward")):
        raise InputError("linear-forward has nothing to predict: all its weights are 0")


METHOD = ClosedForm(
    name="linear-forward",
    words="linear forward code: what the row says, beyond the actions, of what comes next",
    source="reduced-rank regression, Izenman 1975; predictive states, Littman et al. 2001",
    own={
        "latent": REQUIRED,
        "horizons": (1, 5, 10, 20),
        "changes": 1.0,
        "values": 1.0,
        "reward": 1.0,
    },
    check=_check,
    reduces=False,
    make=make,
)
