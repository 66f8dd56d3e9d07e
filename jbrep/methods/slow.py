"""Slow features: the linear directions that change least from now to later."""

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.methods.linear import DEVIATION, check_varying, dense, inverse_root, signed
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.passes import Array, blocks
from jbrep.methods.settings import REQUIRED

LAGS = (1, 2, 5, 10, 20, 50, 100)  # of the spectra that the file keeps


def make(data: ScaledDataset, settings: Settings) -> Made:
    """The generalised eigenvectors of the lagged covariance with the largest eigenvalues.

    With the covariance C of the rows and T, the mean of their symmetrised covariances with the
    rows `lags` steps later in the same episode: T w = a C w. Units are uncorrelated, with standard
    deviation 1/3.
    """
    lags = settings["lags"]
    moments = _Lagged(data, lags)
    root = inverse_root(moments.covariance, f"the features of {data.dataset.folder}")
    eigenvalues, vectors = np.linalg.eigh(root @ moments.symmetric(lags) @ root)
    weight = DEVIATION * signed(vectors[:, ::-1].T @ root)[: settings["latent"]]
    spectra = {
        str(lag): np.linalg.eigvalsh(root @ moments.symmetric((lag,)) @ root)[::-1].tolist()
        for lag in moments.lags
    }
    metrics = {"spectrum": eigenvalues[::-1].tolist(), "spectra": spectra}
    return Made((dense(weight, -weight @ moments.mean),), None, metrics)


class _Lagged:
    """Mean and covariances of the rows of all pairs, at each lag."""

    def __init__(self, data: ScaledDataset, lags: tuple[int, ...]):
        longest = max(lags)
        self.lags = tuple(sorted({*lags, *(lag for lag in LAGS if lag <= longest)}))
        size = data.size
        count, totals = 0, np.zeros((2, len(self.lags), size))
        now, across, later = np.zeros((3, len(self.lags), size, size))
        for block in blocks(data, longest, 4 * size):
            first = block.later(0)
            count += len(first)
            for i, lag in enumerate(self.lags):
                after = block.later(lag)
                totals[:, i] += first.sum(axis=0), after.sum(axis=0)
                now[i] += first.T @ first
                across[i] += first.T @ after
                later[i] += after.T @ after
        used = [self.lags.index(lag) for lag in lags]
        self.mean: Array = totals[:, used].mean(axis=(0, 1)) / count
        outer = np.outer(self.mean, self.mean)
        self.covariance: Array = (now + later)[used].mean(axis=0) / (2 * count) - outer
        self._symmetric = (across + across.transpose(0, 2, 1)) / (2 * count) - outer

    def symmetric(self, lags: tuple[int, ...]) -> Array:
        """The mean of the symmetrised covariances at some lags, (size, size)."""
        chosen: Array = self._symmetric[[self.lags.index(lag) for lag in lags]]
        return chosen.mean(axis=0)


METHOD = ClosedForm(
    name="slow",
    words="slow features: the l linear directions that change least over a lag (TICA)",
    source="Wiskott and Sejnowski 2002; Molgedey and Schuster 1994; Perez-Hernandez et al. 2013",
    own={"latent": REQUIRED, "lags": (10,)},
    check=check_varying,
    reduces=False,
    make=make,
)
