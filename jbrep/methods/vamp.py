"""The code that says most, linearly, of where a state comes to beside its actions."""

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.methods.lagged import Lagged
from jbrep.methods.linear import check_directions, direction_code, whitening
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.passes import Array, Block
from jbrep.methods.settings import REQUIRED


def make(data: ScaledDataset, settings: Settings) -> Made:
    """The first partial canonical directions of now and later, given the actions between.

    With covariances C of the rows x now and y a lag later after their linear regression on the
    actions a of all steps between has been taken off both,

        C_xy.a = C_xy - C_xa C_aa^+ C_ay,  and C_xx.a and C_yy.a alike,

    the spectrum is that of the singular values of K = C_xx.a^(-1/2) C_xy.a C_yy.a^(-1/2), the
    partial canonical correlations (Rao 1969; without actions Hotelling's of 1936, which are VAMP's,
    Wu and Noe 2020). The code is U' C_xx.a^(-1/2) (x - mean), of the first left singular vectors U,
    with standard deviation 1/3 in each unit.

    Of several lags, the directions have the largest mean of squared correlations over the lags, and
    the spectrum is its root; the actions are those up to the longest lag.
    """
    lags, size = settings["lags"], data.size
    longest = max(lags)

    def now(block: Block) -> Array:
        return np.hstack((block.later(0), block.next_actions(longest)))

    lagged = Lagged(data, lags, size + longest * data.task.action_size, now)
    whiten, correlations = _partial(lagged, data)
    chosen = np.hstack(correlations[lagged.places(lags)]) / np.sqrt(len(lags))
    left, singular, _ = np.linalg.svd(chosen, full_matrices=False)
    mean = lagged.now_mean[:size]
    covariance = lagged.now[:size, :size] - np.outer(mean, mean)
    spectra = np.linalg.svd(correlations, compute_uv=False).tolist()
    return direction_code(
        left[:, : settings["latent"]].T @ whiten,
        Moments(mean, covariance),
        singular,
        spectra=dict(zip(map(str, lagged.lags), spectra, strict=True)),
    )


def _partial(lagged: Lagged, data: ScaledDataset) -> tuple[Array, Array]:
    """C_xx.a^(-1/2), (size, size), and K at each lag, (lags, size, size)."""
    size = data.size
    now = lagged.now - np.outer(lagged.now_mean, lagged.now_mean)
    shared = now[:size, size:]
    inverse = np.linalg.pinv(now[size:, size:], hermitian=True)
    effect = shared @ inverse
    whiten = whitening(now[:size, :size] - effect @ shared.T, data)
    correlations = []
    for mean, later, across in zip(lagged.later_mean, lagged.later, lagged.across, strict=True):
        both = across - np.outer(lagged.now_mean, mean)
        rest = later - np.outer(mean, mean) - both[size:].T @ inverse @ both[size:]
        joint = both[:size] - effect @ both[size:]
        correlations.append(whiten @ joint @ whitening(rest, data).T)
    return whiten, np.array(correlations)


METHOD = ClosedForm(
    name="vamp",
    words="the linear code most correlated with the state a lag later, given the actions",
    source="VAMP, Wu and Noe 2020; partial canonical correlations, Rao 1969",
    own={"latent": REQUIRED, "lags": (10,)},
    check=check_directions,
    reduces=False,
    make=make,
)
