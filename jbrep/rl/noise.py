"""Noise on actions that are scaled to [-1, 1], with which agents explore."""

from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta

from jbrep.records.record import Record

if TYPE_CHECKING:
    from stable_baselines3.common.noise import ActionNoise

_DT = 1e-2  # stable-baselines3's unit of time for a step
_Sigma = Annotated[float, Meta(ge=0, le=1e6)]  # standard deviation


class NormalNoise(Record, frozen=True, tag_field="kind", tag="normal"):
    """Independent Gaussian noise on each number of an action, with mean 0."""

    sigma: _Sigma

    def make(self, size: int, steps: int) -> "ActionNoise":
        """The noise of one environment, as a stable-baselines3 object.

        Args:
            size: numbers in an action.
            steps: of the longest episode.
        """
        from stable_baselines3.common.noise import NormalActionNoise

        return NormalActionNoise(np.zeros(size), np.full(size, self.sigma))


class OrnsteinUhlenbeckNoise(Record, frozen=True, tag_field="kind", tag="ornstein-uhlenbeck"):
    """Noise that drifts back to its mean, starting from 0 in each episode."""

    mean: Annotated[float, Meta(ge=-1e6, le=1e6)]
    sigma: _Sigma
    theta: Annotated[float, Meta(ge=0, le=1 / _DT)]  # beyond, it would swing about its mean

    def make(self, size: int, steps: int) -> "ActionNoise":
        """stable-baselines3 takes a step for 0.01 units of time."""
        from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

        mean, sigma = np.full(size, self.mean), np.full(size, self.sigma)
        return OrnsteinUhlenbeckActionNoise(mean, sigma, self.theta)


class ColouredNoise(Record, frozen=True, tag_field="kind", tag="coloured"):
    """Noise with a power in proportion to 1 / frequency^beta, drawn for an episode at once.

    It is white with a beta of 0, pink with 1, which Eberhard et al. (2023, "Pink noise is all you
    need") recommend for many tasks, and red with 2. Numbers of an action are independent; each has
    the standard deviation sigma over an episode.
    """

    beta: Annotated[float, Meta(ge=0, le=2)] = 1.0
    sigma: _Sigma = 0.2

    def make(self, size: int, steps: int) -> "ActionNoise":
        from jbrep.rl.action_noise import ColouredActionNoise

        return ColouredActionNoise(self.beta, self.sigma, size, steps)


Noise = NormalNoise | OrnsteinUhlenbeckNoise | ColouredNoise
