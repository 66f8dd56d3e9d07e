"""Noise with which agents explore."""

import numpy as np
import pytest

from jbrep.rl.noise import ColouredNoise, beginning

STEPS = 1000


def episodes(noise, lanes):
    """What lanes draw in their first episode, (lanes, steps)."""
    generator, memory, drawn = np.random.RandomState(0), beginning(lanes, 1), []
    for _ in range(STEPS):
        memory = noise.after(memory, STEPS, generator)
        drawn.append([each[0, 0] for each in memory])
    return np.array(drawn).T


@pytest.mark.parametrize("beta", [0.0, 0.5, 1.0, 2.0])
def test_coloured_noise_has_its_spectrum_and_spread(beta):
    drawn = episodes(ColouredNoise(beta=beta, sigma=0.3), 64)
    power = (np.abs(np.fft.rfft(drawn)) ** 2).mean(0)
    frequency = np.fft.rfftfreq(STEPS)
    slope, _ = np.polyfit(np.log(frequency[1:-1]), np.log(power[1:-1]), 1)
    assert slope == pytest.approx(-beta, abs=0.05)
    assert np.sqrt((drawn**2).mean()) == pytest.approx(0.3, rel=0.2)


def test_a_lane_draws_its_next_episode_when_the_last_is_over_or_cut_short():
    noise = ColouredNoise().make(2, 4)
    np.random.seed(0)  # noqa: NPY002 - stable-baselines3 draws there
    first, *_, fifth = [noise() for _ in range(5)]
    noise.reset()
    assert noise.memory.shape == (1, 2)
    sixth = noise()
    generator, whole = np.random.RandomState(0), []
    for _ in range(3):
        (memory,) = ColouredNoise().after(beginning(1, 2), 4, generator)
        assert memory.shape == (4, 2)
        whole.append(memory.astype(np.float32))
    for drawn, expected in zip((first, fifth, sixth), whole, strict=True):
        np.testing.assert_array_equal(drawn, expected[0])


def test_an_episode_of_one_step_has_noise():
    (memory,) = ColouredNoise().after(beginning(1, 3), 1, np.random.RandomState(0))
    assert np.isfinite(memory).all()
