"""Running normalisation of what an agent sees."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Array
from jbrep.errors import InputError

if TYPE_CHECKING:
    from stable_baselines3.common.running_mean_std import RunningMeanStd
    from stable_baselines3.common.vec_env import VecEnv, VecNormalize

CLIP = 10.0  # standard deviations
_EPSILON = 1e-8  # added to the variance
_PREFIX = "statistics."  # begins the names of the tensors
_KEPT = ("mean", "variance", "count")  # in files: jbrep's own have one clip and epsilon


@dataclass(frozen=True, eq=False)
class Statistics:
    """The running mean and variance of each of the numbers that an agent sees."""

    # mean, variance: of each number
    mean: Array  # (size,)
    variance: Array  # (size,)
    count: float  # of observations

    @classmethod
    def of(cls, env: "VecNormalize") -> "Statistics":
        """Those of an environment so far."""
        running = _running(env)
        return cls(running.mean, running.var, float(running.count))

    @classmethod
    def read(cls, tensors: Mapping[str, NDArray[Any]], size: int) -> "Statistics":
        """Those that `tensors` gave, among others."""
        mean, variance, count = (tensors.get(_PREFIX + name, np.array(())) for name in _KEPT)
        fits = mean.shape == variance.shape == (size,) and count.size == 1
        if not (fits and np.isfinite([mean, variance]).all() and (variance >= 0).all()):
            raise InputError(f"its statistics aren't a mean and variance of {size} numbers")
        return cls(mean, variance, float(count.item()))

    @property
    def tensors(self) -> dict[str, NDArray[Any]]:
        """Themselves by names, for a file."""
        return {_PREFIX + name: np.asarray(getattr(self, name)) for name in _KEPT}

    @property
    def arrays(self) -> tuple[NDArray[np.float32], ...]:
        """Mean, what float32 rounds off of it, and standard deviation, (size,) each."""
        mean, deviation = self.mean.astype(np.float32), np.sqrt(self.variance + _EPSILON)
        return mean, (self.mean - mean).astype(np.float32), deviation.astype(np.float32)

    def __call__(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """What an agent sees, (n, size), normalised as in training."""
        scaled = (seen - self.mean) / np.sqrt(self.variance + _EPSILON)
        return np.clip(scaled, -CLIP, CLIP).astype(np.float32)

    def give(self, env: "VecNormalize") -> None:
        """Let an environment continue from them."""
        running = _running(env)
        running.mean, running.var = self.mean.copy(), self.variance.copy()
        running.count = self.count


def _running(env: "VecNormalize") -> "RunningMeanStd":
    return cast("RunningMeanStd", env.obs_rms)  # of one array: observations are no dictionaries


def normalized(env: "VecEnv") -> "VecNormalize":
    """An environment whose observations are normalised; its rewards are left as they are."""
    from stable_baselines3.common.vec_env import VecNormalize

    return VecNormalize(env, norm_reward=False, clip_obs=CLIP, epsilon=_EPSILON)
