"""Noise with which agents explore."""

import numpy as np
import pytest

from jbrep.rl.agent import ColouredActionNoise

STEPS = 1000


def episodes(beta, sigma, envs):
    """What environments draw in their first episode, (environments, steps)."""
    np.random.seed(0)  # noqa: NPY002 - stable-baselines3 draws there
    each = [ColouredActionNoise(beta, sigma, 1, STEPS) for _ in range(envs)]
    return np.array([[float(one()[0]) for _ in range(STEPS)] for one in each])


@pytest.mark.parametrize("beta", [0.5, 2.0])
def test_coloured_noise_has_its_spectrum_and_spread(beta):
    drawn = episodes(beta, 0.3, 64)
    power = (np.abs(np.fft.rfft(drawn)) ** 2).mean(0)
    frequency = np.fft.rfftfreq(STEPS)
    slope, _ = np.polyfit(np.log(frequency[1:-1]), np.log(power[1:-1]), 1)
    assert slope == pytest.approx(-beta, abs=0.05)
    assert np.sqrt((drawn**2).mean()) == pytest.approx(0.3, rel=0.2)


def test_noise_of_the_next_episode_is_drawn_when_the_last_is_over_or_cut_short():
    np.random.seed(0)  # noqa: NPY002
    whole = [ColouredActionNoise(1, 0.2, 2, 4) for _ in range(3)]
    firsts = [each() for each in whole]
    np.random.seed(0)  # noqa: NPY002
    noise = ColouredActionNoise(1, 0.2, 2, 4)
    first, *_, fifth = [noise() for _ in range(5)]
    noise.reset()
    for drawn, expected in zip((first, fifth, noise()), firsts, strict=True):
        np.testing.assert_array_equal(drawn, expected)


def test_an_episode_of_one_step_has_noise():
    assert np.isfinite(ColouredActionNoise(1, 0.2, 3, 1)()).all()
