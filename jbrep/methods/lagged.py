"""Slow features and VAMP: linear codes from covariances of now with some steps later."""

from collections.abc import Callable
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.envs.task import Array
from jbrep.methods.linear import Directions, direction_code, whitening
from jbrep.methods.passes import Block, blocks, check_enough
from jbrep.training.method import Made
from jbrep.training.settings import Steps

Lags = Annotated[Steps, Meta(description="Steps from now to later, one or several.")]


class Lagged:
    """Second moments of what is now and the rows some steps later, at several lags, in one pass.

    They are over all windows as long as the longest lag; `now` makes what is now, (m, n) with n =
    `width`, of a block of windows.

    Attributes:
        now_mean, now: (n,) and E[x x'], (n, n).
        later_mean, later: of the rows at each lag, (lags, size) and E[y y'], (lags, size, size).
        across: E[x y'], (lags, n, size).
    """

    def __init__(
        self, data: ScaledDataset, lags: tuple[int, ...], width: int, now: Callable[[Block], Array]
    ):
        longest, count, size, windows = max(lags), len(lags), data.size, 0
        self.now_mean, self.later_mean = np.zeros(width), np.zeros((count, size))
        self.now, self.later = np.zeros((width, width)), np.zeros((count, size, size))
        self.across = np.zeros((count, width, size))
        work = width**2 + count * size * (width + size)
        for block in blocks(data, longest, width + size, work):
            first = now(block)
            windows += len(block)
            self.now_mean += first.sum(axis=0)
            self.now += first.T @ first
            for i, lag in enumerate(lags):
                after = block.later(lag)
                self.later_mean[i] += after.sum(axis=0)
                self.across[i] += first.T @ after
                self.later[i] += after.T @ after
        check_enough(windows, width, data, longest, "a smaller lag")
        for total in (self.now_mean, self.now, self.later_mean, self.later, self.across):
            total /= windows


class Slow(Directions, frozen=True, kw_only=True):
    """Slow features: the l linear directions that change least over a lag (TICA).

    They are the generalised eigenvectors of the lagged covariance with the largest eigenvalues.
    Over all pairs of a row and the one `lags` steps later in its episode, and the same pairs in
    reverse, C is the covariance of the rows and T that of the first with the second of a pair: T w
    = a C w. Of several lags, C and T are those of all their pairs together. Units are uncorrelated,
    with standard deviation 1/3.

    Wiskott and Sejnowski 2002; Molgedey and Schuster 1994; Perez-Hernandez et al. 2013.
    """

    name: ClassVar[str] = "slow"

    lags: Lags = (10,)

    def make(self, data: ScaledDataset) -> Made:
        lagged = Lagged(data, self.lags, data.size, lambda block: block.later(0))
        mean = (lagged.now_mean + lagged.later_mean.mean(axis=0)) / 2
        outer = np.outer(mean, mean)
        covariance = (lagged.now + lagged.later.mean(axis=0)) / 2 - outer
        across = lagged.across.mean(axis=0)
        whiten = whitening(covariance, data)
        lagging = whiten @ ((across + across.T) / 2 - outer) @ whiten.T
        eigenvalues, vectors = np.linalg.eigh(lagging)
        directions = vectors[:, ::-1][:, : self.latent].T @ whiten
        return direction_code(directions, Moments(mean, covariance), eigenvalues[::-1])


class Vamp(Directions, frozen=True, kw_only=True):
    """The linear latent most correlated with the state a lag later, given the actions (VAMP).

    They are the first partial canonical directions of now and later, given the actions between.
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

    name: ClassVar[str] = "vamp"

    lags: Lags = (10,)

    def make(self, data: ScaledDataset) -> Made:
        size, longest = data.size, max(self.lags)

        def now(block: Block) -> Array:
            return np.hstack((block.later(0), block.next_actions(longest)))

        lagged = Lagged(data, self.lags, size + longest * data.task.action_size, now)
        whiten, correlations = _partial(lagged, data)
        side_by_side = np.concatenate(correlations, axis=1) / np.sqrt(len(self.lags))
        left, singular, _ = np.linalg.svd(side_by_side, full_matrices=False)
        mean = lagged.now_mean[:size]
        covariance = lagged.now[:size, :size] - np.outer(mean, mean)
        directions = left[:, : self.latent].T @ whiten
        return direction_code(directions, Moments(mean, covariance), singular)


def _partial(lagged: Lagged, data: ScaledDataset) -> tuple[Array, list[Array]]:
    """C_xx.a^(-1/2), (size, size), and K at each lag."""
    size = data.size
    now = lagged.now - np.outer(lagged.now_mean, lagged.now_mean)
    shared = now[:size, size:]
    inverse = np.linalg.pinv(now[size:, size:], hermitian=True)
    effect = shared @ inverse
    others = "each other or the actions"
    whiten = whitening(now[:size, :size] - effect @ shared.T, data, np.diag(now)[:size], others)
    correlations = []
    for mean, later, across in zip(lagged.later_mean, lagged.later, lagged.across, strict=True):
        both = across - np.outer(lagged.now_mean, mean)
        whole = later - np.outer(mean, mean)
        rest = whole - both[size:].T @ inverse @ both[size:]
        joint = both[:size] - effect @ both[size:]
        after = whitening(rest, data, np.diag(whole), others)
        correlations.append(whiten @ joint @ after.T)
    return whiten, correlations
