"""The algorithms and their settings, as data."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
)

from jbrep.errors import choose
from jbrep.rl.fields import POLICY
from jbrep.rl.names import CLASSES, MODERN, PAPER

Array = NDArray[np.float64]
Hidden = Sequence[int] | Mapping[str, Sequence[int]]


_DT = 1e-2  # stable-baselines3's unit of time for a step


class NormalNoise(NamedTuple):
    """Independent Gaussian noise on each number of an action, with mean 0."""

    sigma: float

    def make(self, size: int) -> ActionNoise:
        """The noise on actions of so many numbers, as a stable-baselines3 object."""
        return NormalActionNoise(np.zeros(size), np.full(size, self.sigma))

    def after(self, previous: Array, generator: np.random.RandomState) -> Array:
        """The next noise as that object draws it; zeros come before an episode's first."""
        return generator.normal(0, self.sigma, previous.shape)


class OrnsteinUhlenbeckNoise(NamedTuple):
    """Noise that drifts back to its mean, starting from 0 in each episode."""

    mean: float
    sigma: float
    theta: float

    def make(self, size: int) -> ActionNoise:
        """As for `NormalNoise`; stable-baselines3 takes a step for 0.01 units of time."""
        mean, sigma = np.full(size, self.mean), np.full(size, self.sigma)
        return OrnsteinUhlenbeckActionNoise(mean, sigma, self.theta)

    def after(self, previous: Array, generator: np.random.RandomState) -> Array:
        """As for `NormalNoise`."""
        pull = self.theta * (self.mean - previous) * _DT
        return previous + pull + self.sigma * np.sqrt(_DT) * generator.normal(size=previous.shape)


@dataclass(frozen=True)
class Preset:
    """Settings of an algorithm; those not named keep stable-baselines3's defaults.

    Attributes:
        hidden: units of the hidden layers of actor and critic, or of each by its name: pi and qf,
            on policy pi and vf.
        settings: arguments of the algorithm's class; "linear:0.1" is a schedule from 0.1 to 0.
        num_envs: lanes stepped together.
        noise: on actions scaled to [-1, 1].
        optimizer: arguments of Adam.
        policy: arguments of the policy's class; activation_fn by its name.
        normalize: whether the agent sees its input by the running mean and variance.
    """

    hidden: Hidden
    settings: Mapping[str, Any]
    num_envs: int = 1
    noise: NormalNoise | OrnsteinUhlenbeckNoise | None = None
    optimizer: Mapping[str, Any] = field(default_factory=dict)
    policy: Mapping[str, Any] = field(default_factory=lambda: dict(POLICY))
    normalize: bool = False


ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    name: resolve_name(path) for name, path in CLASSES.items()
}

_SHARED = {"learning_rate": 1e-4, "gamma": 0.99}
_HIDDEN = (350, 250)
_ON_POLICY = {"eps": 1e-5}  # of Adam, as stable-baselines3 sets it for PPO and A2C
_PAPER = {
    "ddpg": Preset(
        _HIDDEN,
        {
            **_SHARED,
            "batch_size": 256,
            "gradient_steps": 50,
            "train_freq": 100,
            "buffer_size": 1_000_000,
            "tau": 1e-3,
        },
        noise=OrnsteinUhlenbeckNoise(mean=0.3, sigma=0.3, theta=0.15),
    ),
    "td3": Preset(
        _HIDDEN,
        {**_SHARED, "learning_starts": 10_000, "gradient_steps": 1000, "train_freq": 1000},
        noise=NormalNoise(0.2),
    ),
    **{
        name: Preset(
            _HIDDEN, {**_SHARED, "batch_size": 256, "ent_coef": "auto"}, noise=NormalNoise(0.2)
        )
        for name in ("sac", "tqc", "crossq")  # the paper has sac alone
    },
    "ppo": Preset(
        _HIDDEN,
        {
            **_SHARED,
            "n_steps": 256,
            "ent_coef": 0.01,
            "vf_coef": 0.5,
            "max_grad_norm": 0.5,
            "gae_lambda": 0.95,
            "batch_size": 512,  # 4 minibatches of the 8 x 256 steps
            "clip_range": 0.2,
            "clip_range_vf": None,
            "n_epochs": 4,
        },
        num_envs=8,
        optimizer=_ON_POLICY,
    ),
    "a2c": Preset(_HIDDEN, {**_SHARED, "use_rms_prop": False}, num_envs=8, optimizer=_ON_POLICY),
    "trpo": Preset(_HIDDEN, {**_SHARED, "n_steps": 256}, num_envs=8, optimizer=_ON_POLICY),
}

_OFF_POLICY = {"learning_rate": 3e-4, "learning_starts": 1000, "train_freq": 4}
_MODERN = {
    "ddpg": Preset((256, 256), _OFF_POLICY, noise=NormalNoise(0.2)),
    "td3": Preset((256, 256), _OFF_POLICY, noise=NormalNoise(0.2)),
    "sac": Preset((256, 256), _OFF_POLICY),
    "tqc": Preset((256, 256), _OFF_POLICY),
    "crossq": Preset(  # its own layers and learning rate; it has no target networks
        {"pi": (256, 256), "qf": (1024, 1024)}, {**_OFF_POLICY, "learning_rate": 1e-3}
    ),
    "ppo": Preset(
        (64, 64),
        {"learning_rate": 3e-4, "n_steps": 256, "batch_size": 64, "n_epochs": 10},
        num_envs=8,
        optimizer=_ON_POLICY,
    ),
    "a2c": Preset(
        (64, 64),
        {"learning_rate": 7e-4, "use_rms_prop": False, "n_steps": 8, "gae_lambda": 0.9},
        num_envs=8,
        optimizer=_ON_POLICY,
    ),
    "trpo": Preset(
        (64, 64),
        {"learning_rate": 1e-3, "n_steps": 256, "n_critic_updates": 20, "cg_damping": 0.1},
        num_envs=8,
        optimizer=_ON_POLICY,
    ),
}
PRESETS = {PAPER: _PAPER, MODERN: _MODERN}


def get_preset(preset: str, algorithm: str) -> Preset:
    """The settings of an algorithm in the preset of that name.

    Raises:
        InputError: no preset or algorithm of that name; the message lists them.
    """
    choose(algorithm, ALGORITHMS, "algorithm")
    return choose(preset, PRESETS, "preset")[algorithm]
