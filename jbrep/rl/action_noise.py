"""Noise with a memory as stable-baselines3 takes it."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.noise import ActionNoise

from jbrep.envs.task import Array


class StatefulNoise(ActionNoise):
    """Noise in one lane, drawn from the generator that stable-baselines3 draws from.

    Args:
        after: what follows a memory, with numbers of a generator.
        size: numbers in an action.

    Attributes:
        memory: the noise of now, and what is drawn for later, (m, size).
    """

    def __init__(self, after: Callable[[Array, np.random.RandomState], Array], size: int):
        super().__init__()
        self._after, self._size = after, size
        self.memory: Array
        self.reset()

    def __call__(self) -> NDArray[Any]:
        """The noise of the next step, (size,)."""
        self.memory = self._after(self.memory, np.random.mtrand._rand)
        return self.memory[0].astype(np.float32)

    def reset(self) -> None:
        """Start another episode."""
        self.memory = np.zeros((1, self._size))
