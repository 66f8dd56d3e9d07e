"""Coloured noise as stable-baselines3 takes it."""

from typing import Any

import numpy as np
from colorednoise import powerlaw_psd_gaussian
from numpy.typing import NDArray
from stable_baselines3.common.noise import ActionNoise

_SHORTEST = 2  # numbers that have a spectrum


class ColouredActionNoise(ActionNoise):
    """Coloured noise of one environment, from the generator that stable-baselines3 draws from.

    Args:
        beta: the power falls with frequency^beta.
        sigma: the standard deviation over an episode.
        size: numbers in an action.
        steps: of the longest episode.

    Attributes:
        ahead: what is drawn for the steps to come, (m, size).
    """

    def __init__(self, beta: float, sigma: float, size: int, steps: int):
        super().__init__()
        self._beta, self._sigma, self._shape = beta, sigma, (size, max(steps, _SHORTEST))
        self.ahead: NDArray[np.float64]
        self.reset()

    def __call__(self) -> NDArray[Any]:
        """The noise of the next step, (size,)."""
        if not len(self.ahead):
            generator = np.random.mtrand._rand
            unit = powerlaw_psd_gaussian(self._beta, self._shape, random_state=generator)
            self.ahead = np.ascontiguousarray(self._sigma * unit.T)
        now, self.ahead = self.ahead[0], self.ahead[1:]
        return now.astype(np.float32)

    def reset(self) -> None:
        """Start another episode."""
        self.ahead = np.zeros((0, self._shape[0]))
