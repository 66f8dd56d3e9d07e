"""A preset with settings of the user's: which there are, what each may be, and the result."""

import inspect
import json
import warnings
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from jbrep.errors import InputError, choose
from jbrep.rl.agent import ACTIVATIONS, make_agent
from jbrep.rl.fields import HIDDEN
from jbrep.rl.presets import ALGORITHMS, NormalNoise, OrnsteinUhlenbeckNoise, Preset, get_preset
from jbrep.rl.values import is_number, refused, typed
from jbrep.rl.weights import one_line

_NOISES: dict[str, type[NormalNoise] | type[OrnsteinUhlenbeckNoise]] = {
    "normal": NormalNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckNoise,
}
_OF_ADAM = {
    "betas": lambda v: isinstance(v, list) and len(v) == 2 and all(map(is_number, v)),
    "eps": is_number,
    "weight_decay": is_number,
}
_ADAM_EXAMPLE = '{"betas": [0.9, 0.999], "eps": 1e-08, "weight_decay": 0.0}'
_OWN = ("net_arch", "noise", "normalize", "num_envs", "optimizer_kwargs")
_REFUSED = {  # arguments that are jbrep's own, with the reason
    "policy": "the policy is always an MlpPolicy",
    "env": "the environment is made from the task",
    "seed": "the seed is the run's own",
    "device": "give it by --device",
    "verbose": "the command line shows the progress",
    "tensorboard_log": "it is always in the run's folder",
    "policy_kwargs": "set its parts by their own names, such as net_arch or activation_fn",
    "action_noise": "set noise instead",
    "optimizer_class": "the optimiser is always Adam",
    "use_rms_prop": "the optimiser is always Adam",
    "rms_prop_eps": "the optimiser is always Adam",
    "optimize_memory_usage": "a checkpoint needs whole transitions",
    "normalize_images": "observations are no images",
    **dict.fromkeys(
        ("features_extractor_class", "features_extractor_kwargs"), "observations are flat already"
    ),
    **dict.fromkeys(
        (
            "replay_buffer_class",
            "replay_buffer_kwargs",
            "rollout_buffer_class",
            "rollout_buffer_kwargs",
        ),
        "a checkpoint needs the usual buffer",
    ),
}
_NOT_OF_POLICIES = {"observation_space", "action_space", "lr_schedule", "use_sde", "net_arch"}
_SHAPING = ("use_sde",)  # arguments of algorithms that decide which weights a policy has


def used_settings(algorithm: str, preset: str, overrides: Mapping[str, Any]) -> Preset:
    """The settings of a preset with some set differently, all checked.

    Args:
        algorithm: a key of ALGORITHMS.
        preset: a key of PRESETS.
        overrides: by the names of stable-baselines3's parameters, of the algorithm or its policy,
            or num_envs, noise, normalize and optimizer_kwargs.

    Raises:
        InputError: an unknown algorithm, preset or setting, or a value that it can't have.
    """
    base = get_preset(preset, algorithm)
    if not overrides:
        return base
    try:
        text = json.dumps(overrides, allow_nan=False, sort_keys=True)
    except (TypeError, ValueError):
        raise InputError(
            f"settings of {algorithm} have a value that is no finite number, text, list or table"
        ) from None
    return _used(algorithm, preset, text)


@cache  # as it builds an agent
def _used(algorithm: str, preset: str, text: str) -> Preset:
    used = get_preset(preset, algorithm)
    for name, value in json.loads(text).items():
        used = _with(used, algorithm, name, value)
    _check_together(used)
    _build(algorithm, used)
    return used


def _with(preset: Preset, algorithm: str, name: str, value: Any) -> Preset:
    """The preset with one setting checked and set."""
    _check_name(algorithm, name)
    if name == "net_arch":
        return replace(preset, hidden=_hidden(algorithm, value))
    if name == "noise":
        return replace(preset, noise=_noise(value))
    if name == "optimizer_kwargs":
        return replace(preset, optimizer={**preset.optimizer, **_of_adam(value)})
    if name == "normalize":
        return replace(preset, normalize=typed(name, value, bool))
    if name == "num_envs":
        return replace(preset, num_envs=typed(name, value, int))
    if name in (of_class := _parameters(algorithm)):
        checked = typed(name, value, of_class[name])
        return replace(preset, settings={**preset.settings, name: checked})
    return replace(preset, policy={**preset.policy, name: _of_policy(algorithm, name, value)})


def setting_names(algorithm: str) -> list[str]:
    """What can be set of an algorithm.

    Raises:
        InputError: unknown algorithm.
    """
    choose(algorithm, ALGORITHMS, "algorithm")
    own = set(_OWN)
    if not _is_off_policy(algorithm):
        own.remove("noise")
    return sorted({*_parameters(algorithm), *_policy_parameters(algorithm), *own})


def check_shape(algorithm: str, hidden: Any, policy: Mapping[str, Any]) -> None:
    """Check what shapes a policy's network, which may come from a stranger's file.

    Raises:
        InputError: an unknown algorithm or argument, or a value that it can't have.
    """
    choose(algorithm, ALGORITHMS, "algorithm")
    _hidden(algorithm, hidden)
    for name, value in policy.items():
        _of_policy(algorithm, name, value)


def shaping(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Those arguments of an algorithm that decide which weights its policy has."""
    return {name: settings[name] is True for name in _SHAPING if name in settings}


def _check_name(algorithm: str, name: str) -> None:
    if name in _REFUSED:
        raise InputError(f"{name} can't be set: {_REFUSED[name]}")
    names = setting_names(algorithm)
    if name not in names:
        near = get_close_matches(name, names, cutoff=0.5)
        told = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(names)}"
        raise InputError(f"{algorithm} has no setting {name!r}: {told}")


@cache
def _parameters(algorithm: str) -> dict[str, Any]:
    """The arguments of an algorithm's class that can be set, with their types."""
    given = inspect.signature(ALGORITHMS[algorithm]).parameters.values()
    return {
        p.name: p.annotation for p in given if p.name not in _REFUSED and not p.name.startswith("_")
    }


@cache
def _policy_parameters(algorithm: str) -> dict[str, Any]:
    """The same for its policy's class."""
    policy = ALGORITHMS[algorithm].policy_aliases["MlpPolicy"]
    left_out = {*_NOT_OF_POLICIES, *_REFUSED, *_OWN}
    given = inspect.signature(policy).parameters.values()
    return {p.name: p.annotation for p in given if p.name not in left_out}


def _of_policy(algorithm: str, name: str, value: Any) -> Any:
    known = _policy_parameters(algorithm)
    if name not in known:
        raise InputError(f"the policy of {algorithm} has no argument {name!r}")
    if name == "activation_fn":
        if not isinstance(value, str) or value not in ACTIVATIONS:
            raise refused(name, value, f"one of {', '.join(ACTIVATIONS)}")
        return value
    return typed(name, value, known[name])


def _hidden(algorithm: str, value: Any) -> Any:
    parts = {"pi", "qf"} if _is_off_policy(algorithm) else {"pi", "vf"}
    if not HIDDEN.allows(value) or (isinstance(value, dict) and {*value} != parts):
        raise refused("net_arch", value, f"{HIDDEN.words} for {' and '.join(sorted(parts))}")
    return value


def _is_off_policy(algorithm: str) -> bool:
    return issubclass(ALGORITHMS[algorithm], OffPolicyAlgorithm)


def _noise(value: Any) -> NormalNoise | OrnsteinUhlenbeckNoise | None:
    if value in ("none", None):
        return None
    table = value if isinstance(value, dict) else {}
    kind = _NOISES.get(str(table.get("kind")))
    numbers = {name: number for name, number in table.items() if name != "kind"}
    if not kind or {*numbers} != {*kind._fields} or not all(map(is_number, numbers.values())):
        raise refused(
            "noise",
            value,
            'none, {"kind": "normal", "sigma": 0.1}, or {"kind": "ornstein-uhlenbeck", '
            '"mean": 0, "sigma": 0.3, "theta": 0.15}',
        )
    return kind(**{name: float(number) for name, number in numbers.items()})


def _of_adam(value: Any) -> dict[str, Any]:
    given = value if isinstance(value, dict) else {"": value}
    if not all(name in _OF_ADAM and _OF_ADAM[name](each) for name, each in given.items()):
        raise refused("optimizer_kwargs", value, "such as " + _ADAM_EXAMPLE)
    return given


def _check_together(used: Preset) -> None:
    """Check what stable-baselines3 would only find out in training."""
    frequency = used.settings.get("train_freq")
    if isinstance(frequency, list) and frequency[1] == "episode" and used.num_envs > 1:
        raise InputError("train_freq counts episodes: that needs a num_envs of 1")
    dropped = used.settings.get("top_quantiles_to_drop_per_net", 0)
    if dropped and dropped >= (most := used.policy.get("n_quantiles", 25)):
        raise InputError(
            f"top_quantiles_to_drop_per_net is {dropped}: it must be below n_quantiles, {most}"
        )


class _Body(gymnasium.Env[Any, Any]):
    """A task's spaces, whatever the task."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)


def _build(algorithm: str, used: Preset) -> None:
    """Build an agent, so that what stable-baselines3 refuses is known before the first step."""
    small = {"buffer_size": used.num_envs} if "buffer_size" in _parameters(algorithm) else {}
    quick = replace(used, settings={**used.settings, **small})
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # training gives them
            make_agent(algorithm, quick, DummyVecEnv([_Body] * used.num_envs), 0)
    except Exception as error:  # stable-baselines3's own checks raise many types
        raise InputError(
            f"stable-baselines3 can't make {algorithm} with these settings: {one_line(error)}"
        ) from None
