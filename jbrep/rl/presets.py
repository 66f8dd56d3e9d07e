"""Algorithms of stable-baselines3, and the presets of their hyperparameters, as data."""

from collections.abc import Mapping
from functools import cache
from inspect import Parameter, signature
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast

import msgspec
from msgspec import UNSET, Meta, UnsetType

from jbrep.errors import choose
from jbrep.records.record import Finite, Record, from_plain

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

PAPER, MODERN, WIDE = PRESETS = ("paper", "modern", "wide")
MAX_LAYERS, MAX_UNITS = 8, 1024  # of a policy's network
MAX_ENVS = 4096
MAX_REPEAT = 1000
LINEAR = "linear:"  # before the number from which a schedule falls to 0

Layers = Annotated[
    tuple[Annotated[int, Meta(ge=1, le=MAX_UNITS)], ...], Meta(max_length=MAX_LAYERS)
]
_Parts = Annotated[Mapping[str, Layers], Meta(min_length=1, max_length=2)]
NetArch = Layers | _Parts


_Sigma = Annotated[float, Meta(ge=0, le=1e6)]  # standard deviation


class NormalNoise(Record, frozen=True, tag_field="kind", tag="normal"):
    """Independent Gaussian noise on each number of an action scaled to [-1, 1], with mean 0."""

    sigma: _Sigma


class OrnsteinUhlenbeckNoise(Record, frozen=True, tag_field="kind", tag="ornstein-uhlenbeck"):
    """Noise that drifts back to its mean, starting from 0 in each episode.

    stable-baselines3 takes a step for 0.01 units of time: with a larger theta it would swing.
    """

    mean: Annotated[float, Meta(ge=-1e6, le=1e6)]
    sigma: _Sigma
    theta: Annotated[float, Meta(ge=0, le=100)]


class ColouredNoise(Record, frozen=True, tag_field="kind", tag="coloured"):
    """Noise with a power in proportion to 1 / frequency^beta, drawn for an episode at once.

    It is white with a beta of 0, pink with 1, which Eberhard et al. (2023, "Pink noise is all you
    need") recommend for many tasks, and red with 2. Numbers of an action are independent; each has
    the standard deviation sigma over an episode.
    """

    beta: Annotated[float, Meta(ge=0, le=2)] = 1.0
    sigma: _Sigma = 0.2


class _OfAdam(Record, frozen=True):
    betas: tuple[Finite, Finite] | None = None
    eps: Finite | None = None
    weight_decay: Finite | None = None


class Hyperparameters(Record, frozen=True):
    """Those of an algorithm; what isn't named keeps stable-baselines3's default.

    All fields but the arguments of stable-baselines3's classes can be set by their names, too.
    """

    # units of the hidden layers of actor and critic, or of each by its name: pi and qf, on policy
    # pi and vf
    net_arch: NetArch
    # arguments of the algorithm's class; "linear:0.1" is a schedule from 0.1 to 0
    algorithm_kwargs: Mapping[str, Any]
    num_envs: Annotated[int, Meta(ge=1, le=MAX_ENVS)] = 1  # environments stepped together
    # on actions scaled to [-1, 1]
    noise: NormalNoise | OrnsteinUhlenbeckNoise | ColouredNoise | None = None
    optimizer_kwargs: Mapping[str, Any] = {}  # arguments of Adam
    # arguments of the policy's class; activation_fn by its name
    policy_kwargs: Mapping[str, Any] = msgspec.field(
        default_factory=lambda: {"activation_fn": "relu"}
    )
    normalize: bool = False  # whether the agent sees its input by the running mean and variance
    # learning begins after this share of a run's steps, if learning_starts hasn't come before
    warm_up: Annotated[float, Meta(gt=0, le=1)] | UnsetType = UNSET
    # control steps for which each action is held, which are one step of the agent; what else counts
    # steps here counts the agent's
    action_repeat: Annotated[int, Meta(ge=1, le=MAX_REPEAT)] = 1

    def check(self) -> None:
        from_plain(self.optimizer_kwargs, _OfAdam, "optimizer_kwargs")

    def within(self, control_steps: int) -> "Hyperparameters":
        """The same in a run of so many steps, as its warm-up says."""
        if self.warm_up is UNSET:
            return self
        usual = self.algorithm_kwargs["learning_starts"]
        return self.learning_from(min(usual, int(self.warm_up * self.agent_steps(control_steps))))

    def learning_from(self, agent_step: int) -> "Hyperparameters":
        """The same with another step from which the agent learns."""
        changed = {**self.algorithm_kwargs, "learning_starts": agent_step}
        return self.replace(algorithm_kwargs=changed)

    def agent_steps(self, control_steps: int) -> int:
        """The fewest steps of an agent that are so many control steps, or more."""
        return -(-control_steps // self.action_repeat)


class Algorithm(NamedTuple):
    """An algorithm of stable-baselines3, or of others like it."""

    path: str  # of its class
    presets: Mapping[str, Hyperparameters]
    learns_off_policy: bool = True  # from a replay buffer; its actions are squashed, not clipped


_HIDDEN = (350, 250)
_SHARED = {"learning_rate": 1e-4, "gamma": 0.99}
_NOISE = NormalNoise(sigma=0.2)
_OFTEN = {"learning_rate": 3e-4, "learning_starts": 1000, "train_freq": 4}
_MANY_ROBOTS = Hyperparameters(  # few gradient steps: one for 16 steps of a robot
    (128, 128),
    {
        "learning_rate": 1e-3,
        "gamma": 0.99,
        "buffer_size": 1_000_000,
        "learning_starts": 12_800,
        "train_freq": 1,
        "gradient_steps": 8,
        "batch_size": 512,
    },
    num_envs=64,
    warm_up=0.0256,
    action_repeat=2,
)
_OF_ENTROPY = {  # the paper has SAC alone
    PAPER: Hyperparameters(
        _HIDDEN, {**_SHARED, "batch_size": 256, "ent_coef": "auto"}, noise=_NOISE
    ),
    MODERN: Hyperparameters((256, 256), _OFTEN),
    WIDE: _MANY_ROBOTS,
}
_ON_POLICY: dict[str, Any] = {
    "num_envs": 8,
    "optimizer_kwargs": {"eps": 1e-5},  # as stable-baselines3 sets it for PPO and A2C
}

ALGORITHMS = {
    "ddpg": Algorithm(
        "stable_baselines3.DDPG",
        {
            PAPER: Hyperparameters(
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
            MODERN: Hyperparameters((256, 256), _OFTEN, noise=_NOISE),
            WIDE: _MANY_ROBOTS.replace(noise=_NOISE),
        },
    ),
    "td3": Algorithm(
        "stable_baselines3.TD3",
        {
            PAPER: Hyperparameters(
                _HIDDEN,
                {**_SHARED, "learning_starts": 10_000, "gradient_steps": 1000, "train_freq": 1000},
                noise=_NOISE,
            ),
            MODERN: Hyperparameters((256, 256), _OFTEN, noise=_NOISE),
            WIDE: _MANY_ROBOTS.replace(noise=_NOISE),
        },
    ),
    "sac": Algorithm("stable_baselines3.SAC", {**_OF_ENTROPY}),
    "ppo": Algorithm(
        "stable_baselines3.PPO",
        {
            PAPER: Hyperparameters(
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
                **_ON_POLICY,
            ),
            MODERN: Hyperparameters(
                (64, 64),
                {"learning_rate": 3e-4, "n_steps": 256, "batch_size": 64, "n_epochs": 10},
                **_ON_POLICY,
            ),
        },
        learns_off_policy=False,
    ),
    "a2c": Algorithm(
        "stable_baselines3.A2C",
        {
            PAPER: Hyperparameters(_HIDDEN, {**_SHARED, "use_rms_prop": False}, **_ON_POLICY),
            MODERN: Hyperparameters(
                (64, 64),
                {"learning_rate": 7e-4, "use_rms_prop": False, "n_steps": 8, "gae_lambda": 0.9},
                **_ON_POLICY,
            ),
        },
        learns_off_policy=False,
    ),
    "trpo": Algorithm(
        "sb3_contrib.TRPO",
        {
            PAPER: Hyperparameters(_HIDDEN, {**_SHARED, "n_steps": 256}, **_ON_POLICY),
            MODERN: Hyperparameters(
                (64, 64),
                {"learning_rate": 1e-3, "n_steps": 256, "n_critic_updates": 20, "cg_damping": 0.1},
                **_ON_POLICY,
            ),
        },
        learns_off_policy=False,
    ),
    "tqc": Algorithm("sb3_contrib.TQC", {**_OF_ENTROPY}),
    "crossq": Algorithm(
        "sb3_contrib.CrossQ",
        {
            **_OF_ENTROPY,
            MODERN: Hyperparameters(  # its own layers and learning rate; it has no target networks
                {"pi": (256, 256), "qf": (1024, 1024)}, {**_OFTEN, "learning_rate": 1e-3}
            ),
        },
    ),
}


def base_name(algorithm: str, preset: str) -> str:
    """An algorithm with its preset: ddpg-paper, sac-wide."""
    return f"{algorithm}-{preset}"


def usual_preset(algorithm: str) -> str:
    """The preset that commands take if none is named: many robots, where it has the algorithm."""
    known = choose(algorithm, ALGORITHMS, "algorithm").presets
    return WIDE if WIDE in known else MODERN


def get_preset(preset: str, algorithm: str) -> Hyperparameters:
    """The hyperparameters of an algorithm in the preset of that name."""
    known = choose(algorithm, ALGORITHMS, "algorithm").presets
    return choose(preset, known, f"preset of {algorithm}")


def sb3_class(algorithm: str) -> "type[BaseAlgorithm]":
    """The class that has an algorithm in stable-baselines3."""
    path = choose(algorithm, ALGORITHMS, "algorithm").path
    return cast("type[BaseAlgorithm]", resolve_name(path))


@cache
def parameters_of(algorithm: str) -> tuple[Mapping[str, Parameter], Mapping[str, Parameter]]:
    """What stable-baselines3's class of an algorithm takes, and what that of its policy does."""
    kind = sb3_class(algorithm)
    return signature(kind).parameters, signature(kind.policy_aliases["MlpPolicy"]).parameters


def argument(algorithm: str, chosen: Hyperparameters, name: str) -> Any:
    """What an algorithm's class gets by that name, if only by default; None if it takes none."""
    usual, _ = parameters_of(algorithm)
    return chosen.algorithm_kwargs.get(name, usual[name].default) if name in usual else None


def learns_from(algorithm: str, chosen: Hyperparameters) -> int:
    """The control step from which an agent learns; until then it acts at random."""
    return (argument(algorithm, chosen, "learning_starts") or 0) * chosen.action_repeat
