"""Noise on actions that are scaled to [-1, 1], with which agents explore.

Each lane has a memory, (m, k): the noise of now, then what is drawn for later already. It is zeros
before an episode's first step.
"""

from functools import partial
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta

from jbrep.envs.task import Array
from jbrep.records.record import Record

if TYPE_CHECKING:
    from stable_baselines3.common.noise import ActionNoise

_DT = 1e-2  # stable-baselines3's unit of time for a step
_SHORTEST = 2  # numbers that have a spectrum
Memory = list[Array]  # of each lane, (m, k)
_Sigma = Annotated[float, Meta(ge=0, le=1e6)]  # standard deviation


def beginning(lanes: int, size: int) -> Memory:
    """What lanes remember at the start of an episode, for actions of so many numbers."""
    return [np.zeros((1, size)) for _ in range(lanes)]


class NormalNoise(Record, frozen=True, tag_field="kind", tag="normal"):
    """Independent Gaussian noise on each number of an action, with mean 0."""

    sigma: _Sigma

    def make(self, size: int, steps: int) -> "ActionNoise":
        """The noise in one lane, as a stable-baselines3 object.

        Args:
            size: k, numbers in an action.
            steps: of the longest episode.
        """
        from stable_baselines3.common.noise import NormalActionNoise

        return NormalActionNoise(np.zeros(size), np.full(size, self.sigma))

    def after(self, memory: Memory, steps: int, generator: np.random.RandomState) -> Memory:
        """What lanes remember a step later, with the numbers that the object above draws."""
        return [*generator.normal(0, self.sigma, (len(memory), *memory[0].shape))]


class OrnsteinUhlenbeckNoise(Record, frozen=True, tag_field="kind", tag="ornstein-uhlenbeck"):
    """Noise that drifts back to its mean, starting from 0 in each episode."""

    mean: Annotated[float, Meta(ge=-1e6, le=1e6)]
    sigma: _Sigma
    theta: Annotated[float, Meta(ge=0, le=1 / _DT)]  # beyond, it would swing about its mean

    def make(self, size: int, steps: int) -> "ActionNoise":
        """As for `NormalNoise`; stable-baselines3 takes a step for 0.01 units of time."""
        from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

        mean, sigma = np.full(size, self.mean), np.full(size, self.sigma)
        return OrnsteinUhlenbeckActionNoise(mean, sigma, self.theta)

    def after(self, memory: Memory, steps: int, generator: np.random.RandomState) -> Memory:
        previous = np.stack(memory)
        pull = self.theta * (self.mean - previous) * _DT
        change = self.sigma * np.sqrt(_DT) * generator.normal(size=previous.shape)
        return [*(previous + pull + change)]


class ColouredNoise(Record, frozen=True, tag_field="kind", tag="coloured"):
    """Noise with a power in proportion to 1 / frequency^beta, drawn for an episode at once.

    It is white with a beta of 0, pink with 1, which Eberhard et al. (2023, "Pink noise is all you
    need") recommend for many tasks, and red with 2. Numbers of an action are independent; each has
    the standard deviation sigma over an episode.
    """

    beta: Annotated[float, Meta(ge=0, le=2)] = 1.0
    sigma: _Sigma = 0.2

    def make(self, size: int, steps: int) -> "ActionNoise":
        from jbrep.rl.action_noise import StatefulNoise

        return StatefulNoise(partial(self._next, steps=steps), size)

    def after(self, memory: Memory, steps: int, generator: np.random.RandomState) -> Memory:
        return [self._next(each, generator, steps) for each in memory]

    def _next(self, memory: Array, generator: np.random.RandomState, steps: int) -> Array:
        """What one lane remembers a step later."""
        if len(memory) > 1:
            return memory[1:]
        return self._drawn(memory.shape[1], steps, generator)

    def _drawn(self, size: int, steps: int, generator: np.random.RandomState) -> Array:
        """The noise of an episode, (steps, size)."""
        from colorednoise import powerlaw_psd_gaussian

        shape = (size, max(steps, _SHORTEST))
        unit = powerlaw_psd_gaussian(self.beta, shape, random_state=generator)
        return np.ascontiguousarray(self.sigma * unit.T)


Noise = NormalNoise | OrnsteinUhlenbeckNoise | ColouredNoise
