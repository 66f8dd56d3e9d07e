"""Coloured noise as stable-baselines3 takes it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.noise import ActionNoise

from jbrep.envs.task import Array
from jbrep.rl.noise import ColouredNoise, beginning


class ColouredActionNoise(ActionNoise):
    """Coloured noise in one lane, drawn from the generator that stable-baselines3 draws from.

    Args:
        noise: what it is like.
        size: numbers in an action.
        steps: of the longest episode.

    Attributes:
        memory: the noise of now, and what is drawn for later, (m, size).
    """

    def __init__(self, noise: ColouredNoise, size: int, steps: int):
        super().__init__()
        self._noise, self._steps, self._size = noise, steps, size
        self.memory: Array
        self.reset()

    def __call__(self) -> NDArray[Any]:
        """The noise of the next step, (size,)."""
        generator = np.random.mtrand._rand
        (self.memory,) = self._noise.after([self.memory], self._steps, generator)
        return self.memory[0].astype(np.float32)

    def reset(self) -> None:
        """Start another episode."""
        (self.memory,) = beginning(1, self._size)
