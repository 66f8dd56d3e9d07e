"""Levels of tests at the looks of a study: its verdicts together are as strict as one test.

O'Brien and Fleming 1979, "A multiple testing procedure for clinical trials", Biometrics 35: at the
look with a share t of all runs, a statistic that is standard normal if there is no effect decides
beyond C / sqrt(t). The constant C is found by integrating over the paths that haven't decided yet,
as in Armitage, McPherson and Rowe 1969, "Repeated significance tests on accumulating data".
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import norm

_POINTS = 401  # of the grid on which paths are integrated, with Simpson's rule


@lru_cache(256)
def levels(shares: Sequence[float], level: float) -> tuple[float, ...]:
    """The two-sided level of the test at each look.

    Args:
        shares: of the runs that are there at each look, ascending to 1.
        level: of all looks together, two-sided.
    """
    if len(shares) == 1:
        return (level,)
    least = norm.isf(level / 2)
    constant = brentq(lambda c: _decided(shares, c) - level, least - 0.1, 2 * least + 2)
    return tuple(2 * norm.sf(constant / np.sqrt(shares)).astype(float))


def _decided(shares: Sequence[float], constant: float) -> float:
    """The probability that one of the looks decides if there is no effect."""
    score, weight, before, undecided = np.zeros(1), np.ones(1), 0.0, 1.0
    for share in shares:  # a score with variance t, which decides beyond C
        spread = np.sqrt(share - before)
        grid = np.linspace(-constant, constant, _POINTS)
        density = norm.pdf(grid[:, None], score, spread) @ weight
        stays = norm.cdf(constant, score, spread) - norm.cdf(-constant, score, spread)
        undecided = float(weight @ stays)
        score, weight, before = grid, density * _simpson(grid), share
    return 1 - undecided


def _simpson(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """The weights of an integral over an odd number of evenly spaced points."""
    weights = np.full(len(grid), 2.0)
    weights[1::2] = 4
    weights[[0, -1]] = 1
    return weights * (grid[1] - grid[0]) / 3
