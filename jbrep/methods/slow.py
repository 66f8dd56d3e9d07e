"""Slow features: the linear directions that change least from now to later."""

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.methods.lagged import Lagged
from jbrep.methods.linear import check_directions, direction_code, whitening
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.passes import Array
from jbrep.methods.settings import REQUIRED


def make(data: ScaledDataset, settings: Settings) -> Made:
    """The generalised eigenvectors of the lagged covariance with the largest eigenvalues.

    Over all pairs of a row and the one `lags` steps later in its episode, and the same pairs in
    reverse, C is the covariance of the rows and T that of the first with the second of a pair:
    T w = a C w. Of several lags, C and T are those of all their pairs together. Units are
    uncorrelated, with standard deviation 1/3.
    """
    lagged = Lagged(data, settings["lags"], data.size, lambda block: block.later(0))
    eigenvalues, directions, moments = _slowest(lagged, settings["lags"], data)
    spectra = {str(lag): _slowest(lagged, (lag,), data)[0].tolist() for lag in lagged.lags}
    return direction_code(directions[: settings["latent"]], moments, eigenvalues, spectra=spectra)


def _slowest(
    lagged: Lagged, lags: tuple[int, ...], data: ScaledDataset
) -> tuple[Array, Array, Moments]:
    """Eigenvalues, the largest first, and directions (size, size), with the moments of the rows."""
    places = lagged.places(lags)
    mean = (lagged.now_mean + lagged.later_mean[places].mean(axis=0)) / 2
    outer = np.outer(mean, mean)
    covariance = (lagged.now + lagged.later[places].mean(axis=0)) / 2 - outer
    across = lagged.across[places].mean(axis=0)
    whiten = whitening(covariance, data)
    eigenvalues, vectors = np.linalg.eigh(whiten @ ((across + across.T) / 2 - outer) @ whiten.T)
    return eigenvalues[::-1], vectors[:, ::-1].T @ whiten, Moments(mean, covariance)


METHOD = ClosedForm(
    name="slow",
    words="slow features: the l linear directions that change least over a lag (TICA)",
    source="Wiskott and Sejnowski 2002; Molgedey and Schuster 1994; Perez-Hernandez et al. 2013",
    own={"latent": REQUIRED, "lags": (10,)},
    check=check_directions,
    reduces=False,
    make=make,
)
