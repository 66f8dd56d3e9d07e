"""The linear forward code: what now says, beyond the actions, of what comes next."""

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.errors import InputError
from jbrep.methods.linear import check_directions, direction_code, whitening
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.passes import Array, blocks
from jbrep.methods.settings import REQUIRED
from jbrep.methods.targets import PARTS, change, check_targets, nothing_varies, turns

_NEGLIGIBLE = 1e-12  # variance of a target that says nothing
_NO_RANK = 1e-9  # singular value, as a share of the largest


def make(data: ScaledDataset, settings: Settings) -> Made:
    """Reduced-rank regression of what comes next on the row and the actions (Izenman 1975).

    Targets, at each horizon k: the change of each number over k steps, its value then, and the mean
    reward until then. Changes and values are brought to a variance of their weights, the reward to
    its weight times the numbers in a row: at equal weights it counts as much as all changes
    together. They are regressed on the centred row x and the next actions together; B is the block
    of coefficients of the row, C its covariance. The code is U' C^(-1/2) (x - mean), of the first
    left singular vectors U of C^(1/2) B; its units have standard deviation 1/3. The spectrum is
    that of the singular values.

    It takes one pass over the windows; over a sample of them where rows are wide, see `blocks`.
    """
    size = data.size
    moments, shared, variances = _moments(data, settings)
    weights = _weights(data, settings)
    varies = variances > _NEGLIGIBLE
    scale = np.where(varies, weights / np.sqrt(np.where(varies, variances, 1)), 0)
    if not scale.any():
        raise nothing_varies(data, "linear-forward")
    coefficients = np.linalg.lstsq(moments.covariance, shared * scale, rcond=None)[0]
    here = Moments(moments.mean[:size], moments.covariance[:size, :size])
    whiten = whitening(here.covariance, data)
    left, singular, _ = np.linalg.svd(
        whiten @ here.covariance @ coefficients[:size], full_matrices=False
    )
    rank = int((singular > _NO_RANK * singular[0]).sum())
    if settings["latent"] > rank:
        raise InputError(
            f"latent size is {settings['latent']}: what linear-forward is to predict has rank "
            f"{rank} in {data.dataset.folder}, so it must be from 1 to {rank}"
        )
    return direction_code(left[:, : settings["latent"]].T @ whiten, here, singular)


def _weights(data: ScaledDataset, settings: Settings) -> Array:
    """The standard deviation that each target is brought to, (t,)."""
    sizes = data.size, data.size, 1
    once = [
        np.full(n, np.sqrt(settings[name] * data.size / n))
        for n, name in zip(sizes, PARTS, strict=True)
    ]
    return np.tile(np.concatenate(once), len(settings["horizons"]))


def _moments(data: ScaledDataset, settings: Settings) -> tuple[Moments, Array, Array]:
    """Moments of rows with actions (p,), their covariances with targets, (p, t), and variances.

    The variances are those of the targets, (t,).
    """
    horizons, size = settings["horizons"], data.size
    longest, turn = max(horizons), turns(data)
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
    mean = total / count
    covariance = products / count - np.outer(mean[:regressors], mean)
    moments = Moments(mean[:regressors], covariance[:, :regressors])
    return moments, covariance[:, regressors:], squares / count - mean[regressors:] ** 2


def _check(data: ScaledDataset, settings: Settings) -> None:
    check_directions(data, settings)
    check_targets(data, settings, "linear-forward")


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
