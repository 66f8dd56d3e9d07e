"""Hyperparameters that a user sets: which there are, what each may be, and the result."""

import json
import types
import typing
import warnings
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from functools import cache, partial
from typing import Annotated, Any, Literal

import numpy as np
from gymnasium import spaces
from msgspec import UNSET, Meta
from stable_baselines3.common.vec_env import DummyVecEnv

from jbrep.errors import InputError, refusing
from jbrep.records.record import converted, pattern, shown, to_plain
from jbrep.rl.agent import ACTIVATIONS, Spaces, global_random_state_kept, make_agent, one_line
from jbrep.rl.presets import (
    ALGORITHMS,
    Hyperparameters,
    NetArch,
    argument,
    get_preset,
    parameters_of,
)

_MOST = 10**9  # of any number
_MOST_BYTES = 1 << 27  # of networks; the rest is for observations and an encoder
_ANY_SPACES = (spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Box(-1, 1, (1,), np.float32))
_RANGES: dict[str, tuple[float, float]] = {  # others: from 1 if whole, else from 0
    **dict.fromkeys(("gamma", "tau", "gae_lambda", "batch_norm_momentum"), (0, 1)),
    "gradient_steps": (-1, _MOST),
    **dict.fromkeys(("learning_starts", "top_quantiles_to_drop_per_net"), (0, _MOST)),
    "renorm_warmup_steps": (0, _MOST),
    "target_entropy": (-_MOST, _MOST),
    "log_std_init": (-20, 20),
    "n_critics": (1, 10),
    "n_quantiles": (1, 200),
}
_SCHEDULE = Annotated[
    str,
    pattern(
        r"\Alinear:([0-9]+\.?[0-9]*|\.[0-9]+)(e-?[0-9]{1,2})?\Z",
        "a number, or linear:NUMBER for one that falls to 0",
    ),
]
_FREQUENCY = Annotated[  # of two parts, but msgspec 0.22 crashes on that beside a bounded number
    tuple[Annotated[int, Meta(ge=1)] | Literal["step", "episode"], ...],
    Meta(min_length=2, max_length=2),
]
_OWN = {*Hyperparameters.__struct_fields__} - {"algorithm_kwargs", "policy_kwargs"}
_NO_SDE = "a checkpoint has no noise on features"
_REFUSED = {  # arguments that are jbrep's own, with the reason
    "device": "give it by --device",
    "policy_kwargs": "set its parts by their own names, such as net_arch or activation_fn",
    "action_noise": "set noise instead",
    **dict.fromkeys(("policy", "env", "seed", "verbose", "tensorboard_log"), "the run decides it"),
    **dict.fromkeys(
        ("optimizer_class", "use_rms_prop", "rms_prop_eps"), "the optimiser is always Adam"
    ),
    **dict.fromkeys(
        (
            *("normalize_images", "share_features_extractor"),
            *("features_extractor_class", "features_extractor_kwargs"),
        ),
        "observations are flat already",
    ),
    **dict.fromkeys(
        (
            *("replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage"),
            *("rollout_buffer_class", "rollout_buffer_kwargs"),
        ),
        "a checkpoint needs the usual buffer",
    ),
    **dict.fromkeys(
        (
            *("use_sde", "sde_sample_freq", "use_sde_at_warmup"),
            *("use_expln", "full_std", "clip_mean"),
        ),
        _NO_SDE,
    ),
}
_NOT_OF_POLICIES = {"observation_space", "action_space", "lr_schedule"}


def overridden(algorithm: str, preset: str, overrides: Mapping[str, Any]) -> Hyperparameters:
    """The hyperparameters of a preset with some set differently, all checked.

    By the names of stable-baselines3's parameters, of the algorithm or its policy, or of the other
    fields of `Hyperparameters`.
    """
    base = get_preset(preset, algorithm)
    if not overrides:
        return base
    try:
        text = json.dumps(overrides, allow_nan=False, sort_keys=True, default=lambda v: v.item())
    except (AttributeError, TypeError, ValueError):
        raise InputError(
            f"settings of {algorithm} have a value that is no finite number, text, list or table"
        ) from None
    return _overridden(algorithm, preset, text)


@cache  # as it builds an agent
def _overridden(algorithm: str, preset: str, text: str) -> Hyperparameters:
    result = get_preset(preset, algorithm)
    for name, value in json.loads(text).items():
        _check_name(algorithm, name)
        if isinstance(value, float) and value.is_integer():
            value = int(value)  # 1e5
        result = _changed(result, algorithm, name, value)
    _check_together(algorithm, result)
    _build(algorithm, result)
    return result


def _changed(before: Hyperparameters, algorithm: str, name: str, value: Any) -> Hyperparameters:
    if name in (of_class := _parameters(algorithm)):
        checked = _typed(name, value, of_class[name])
        if name == "learning_starts":
            before = before.replace(warm_up=UNSET)
        return before.replace(algorithm_kwargs={**before.algorithm_kwargs, name: checked})
    if name not in _OWN:
        checked = _of_policy(algorithm, name, value)
        return before.replace(policy_kwargs={**before.policy_kwargs, name: checked})
    if name == "optimizer_kwargs" and isinstance(value, dict):
        value = {**before.optimizer_kwargs, **value}
    if name == "net_arch" and type(value) is int:
        value = [value]
    if name == "warm_up":
        before = before.learning_from(argument(algorithm, before, "learning_starts"))
    after = before.replace(**{name: _or_none(value)})
    _check_parts(algorithm, after.net_arch)
    return after


def check_shape(algorithm: str, hyperparameters: Hyperparameters) -> Hyperparameters:
    """Those of hyperparameters, perhaps a stranger's, that decide which weights a policy has."""
    _check_parts(algorithm, hyperparameters.net_arch)
    return Hyperparameters(
        hyperparameters.net_arch,
        {},
        policy_kwargs={
            name: _of_policy(algorithm, name, value)
            for name, value in hyperparameters.policy_kwargs.items()
        },
        normalize=hyperparameters.normalize,
    )


def without_buffer(algorithm: str, hyperparameters: Hyperparameters) -> Hyperparameters:
    """The same with the smallest replay buffer, for an agent that nothing is added to."""
    if not ALGORITHMS[algorithm].learns_off_policy:
        return hyperparameters
    of_class = {**hyperparameters.algorithm_kwargs, "buffer_size": 1}
    return hyperparameters.replace(algorithm_kwargs=of_class)


def _check_name(algorithm: str, name: str) -> None:
    refused, off_policy = _REFUSED, ALGORITHMS[algorithm].learns_off_policy
    if off_policy:
        refused = {**refused, "log_std_init": _NO_SDE}  # elsewhere it is that of all noise
    if name in refused:
        raise InputError(f"{name} can't be set: {refused[name]}")
    own = _OWN if off_policy else _OWN - {"noise", "warm_up"}
    names = sorted({*_parameters(algorithm), *_policy_parameters(algorithm), *own})
    if name not in names:
        meant = [each for each in names if name == "".join(word[0] for word in each.split("_"))]
        near = meant or get_close_matches(name, names, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}?" if near else f"it has {', '.join(names)}"
        raise InputError(f"{algorithm} has no setting {name!r}: {hint}")


@cache
def _parameters(algorithm: str) -> dict[str, Any]:
    """The arguments of an algorithm's class that can be set, with their types."""
    left_out = {*_REFUSED, "_init_setup_model"}
    of_class, _ = parameters_of(algorithm)
    return {name: each.annotation for name, each in of_class.items() if name not in left_out}


@cache
def _policy_parameters(algorithm: str) -> dict[str, Any]:
    left_out = {*_NOT_OF_POLICIES, *_REFUSED, *_OWN}
    _, of_policy = parameters_of(algorithm)
    types = {name: each.annotation for name, each in of_policy.items() if name not in left_out}
    return {**types, "activation_fn": Literal[tuple(ACTIVATIONS)]}


def _of_policy(algorithm: str, name: str, value: Any) -> Any:
    known = _policy_parameters(algorithm)
    if name not in known:
        raise InputError(f"the policy of {algorithm} has no argument {name!r}")
    return _typed(name, value, known[name])


def _check_parts(algorithm: str, net_arch: NetArch) -> None:
    parts = ["pi", "qf" if ALGORITHMS[algorithm].learns_off_policy else "vf"]
    if isinstance(net_arch, Mapping) and sorted(net_arch) != parts:
        raise InputError(f"net_arch is {shown(net_arch)}: its parts must be {' and '.join(parts)}")


def _typed(name: str, value: Any, annotation: Any) -> Any:
    value = _or_none(value) if types.NoneType in typing.get_args(annotation) else value
    return to_plain(converted(value, _allowed(name, annotation), name))


def _or_none(value: Any) -> Any:
    """A value as TOML has it, which has no null."""
    return None if value == "none" else value


@cache
def _allowed(name: str, annotation: Any) -> Any:
    """What JSON may say of a parameter of that name and type."""
    is_union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    kinds = typing.get_args(annotation) if is_union else (annotation,)
    least, most = _RANGES.get(name, (1 if int in kinds else 0, _MOST))
    bounds = Meta(ge=least, le=most)
    as_json = {int: Annotated[int, bounds], float: Annotated[float, bounds], types.NoneType: None}
    options = [_FREQUENCY if typing.get_origin(k) is tuple else as_json.get(k, k) for k in kinds]
    options = [_SCHEDULE if Callable in (k, typing.get_origin(k)) else k for k in options]
    return typing.Union[tuple(options)]  # noqa: UP007 - of a list


def _check_together(algorithm: str, chosen: Hyperparameters) -> None:
    """Check what stable-baselines3 would only find out in training, or never."""
    given = partial(argument, algorithm, chosen)
    frequency, steps = given("train_freq"), given("gradient_steps")
    if isinstance(frequency, list) and frequency[1] == "episode" and chosen.num_envs > 1:
        raise InputError("train_freq counts episodes: that needs a num_envs of 1")
    if steps == 0:
        raise InputError(
            "gradient_steps is 0, so nothing would be learned: give a positive number, or -1 for "
            "one for each step"
        )
    if (dropped := given("top_quantiles_to_drop_per_net")) is not None:
        usual = parameters_of(algorithm)[1]["n_quantiles"].default
        if dropped >= (of := chosen.policy_kwargs.get("n_quantiles", usual)):
            raise InputError(
                f"top_quantiles_to_drop_per_net is {dropped}: of {of} quantiles one must be left"
            )


def _build(algorithm: str, chosen: Hyperparameters) -> None:
    """Build an agent, so that what stable-baselines3 refuses is known before the first step."""
    small = without_buffer(algorithm, chosen)
    what = f"stable-baselines3 can't make {algorithm} with these settings"
    with refusing(what, describe=one_line), warnings.catch_warnings(), global_random_state_kept():
        warnings.simplefilter("ignore")  # training gives them
        env = DummyVecEnv([lambda: Spaces(*_ANY_SPACES)] * chosen.num_envs)
        agent = make_agent(algorithm, small, env, 0)
        size = sum(each.nbytes for each in agent.policy.state_dict().values())
        if size > _MOST_BYTES:
            raise InputError(
                f"the networks take {size:,} bytes: {_MOST_BYTES:,} are possible, so take fewer or "
                "smaller layers, or fewer critics"
            )
