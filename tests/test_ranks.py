"""Rank correlations are those of an independent implementation."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from jbrep.stats.association import rank_correlation


@pytest.mark.parametrize("ties", [False, True])
def test_it_is_spearmans(ties):
    x, noise = np.random.default_rng(0).normal(size=(2, 12))
    y = x + noise
    if ties:
        x, y = x.round(), y.round()
    value, low, high = rank_correlation(x, y)
    assert value == pytest.approx(spearmanr(x, y).statistic)
    assert -1 <= low < value < high <= 1
    assert rank_correlation(x, y) == rank_correlation(np.exp(x), 3 * y)  # ranks alone count
    assert rank_correlation(x, y, seed=1) != rank_correlation(x, y)
    assert rank_correlation(-x, y).value == pytest.approx(-value)


def test_few_pairs_and_constant_values_say_nothing():
    x = np.arange(5.0)
    assert np.isnan(rank_correlation(x[:4], x[:4])).all()
    assert np.isnan(rank_correlation(x, np.ones(5))).all()
    assert rank_correlation(x, x).value == 1
