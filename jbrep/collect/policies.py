"""Policies to collect with, each a few constants that name it in a command and in a manifest."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Protocol

import numpy as np

from jbrep.errors import InputError, choose
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, EPISODE_STEPS, Array, Task

Actor = Callable[[Array], Array]  # observations (n, d) to actions (n, 1), once for each step

_MAX_SIGMA = 1e6  # far beyond full drive to and fro


class Policy(Protocol):
    """How actions come about; a frozen dataclass of its constants."""

    kind: ClassVar[str]
    open_loop: ClassVar[bool]  # whether actions don't depend on what is observed

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Act in n new episodes, drawing from each one's generator only."""


def _recite(actions: Array) -> Actor:
    """Give actions (T, n, 1) one step after the other."""
    following = iter(actions)
    return lambda observation: next(following)


@dataclass(frozen=True)
class Uniform:
    """Uniformly random drives in [-1, 1], a new one for each step."""

    kind: ClassVar[str] = "uniform"
    open_loop: ClassVar[bool] = True

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Draw all actions of the episodes."""
        return _recite(np.stack([r.uniform(-1, 1, (EPISODE_STEPS, 1)) for r in randoms], axis=1))


@dataclass(frozen=True)
class Constant:
    """The same drive throughout."""

    kind: ClassVar[str] = "constant"
    open_loop: ClassVar[bool] = True
    drive: float = 1.0  # in [-1, 1]

    def __post_init__(self) -> None:
        if not -1 <= self.drive <= 1:
            raise InputError(f"the constant drive is {self.drive}: it must be in [-1, 1]")

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Nothing is drawn."""
        actions = np.full((len(randoms), 1), self.drive)
        return lambda observation: actions


@dataclass(frozen=True)
class OrnsteinUhlenbeck:
    """Noise that wanders about a mean, from the mean on, cut to [-1, 1].

    dx = theta (mu - x) dt + sigma dW, in steps of the control timestep (Uhlenbeck and Ornstein,
    1930); after a while x has the standard deviation sigma / sqrt(2 theta).
    """

    kind: ClassVar[str] = "ornstein-uhlenbeck"
    open_loop: ClassVar[bool] = True
    mu: float = 0.0
    theta: float = 0.15  # [1/s]
    sigma: float = 0.3  # [1/sqrt(s)]

    def __post_init__(self) -> None:
        rate = self.theta * CONTROL_TIMESTEP
        if not (-1 <= self.mu <= 1 and 0 <= rate <= 1 and 0 <= self.sigma <= _MAX_SIGMA):
            raise InputError(
                f"{self}: mu must be in [-1, 1], theta in [0, {1 / CONTROL_TIMESTEP:g}], "
                f"sigma in [0, {_MAX_SIGMA:g}]"
            )

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Draw all actions of the episodes."""
        noise = np.stack([r.standard_normal((EPISODE_STEPS, 1)) for r in randoms], axis=1)
        walk = np.empty_like(noise)
        drive = np.full_like(noise[0], self.mu)
        for step, kick in enumerate(noise):
            walk[step] = drive
            drive = drive + self.theta * CONTROL_TIMESTEP * (self.mu - drive)
            drive = drive + self.sigma * np.sqrt(CONTROL_TIMESTEP) * kick
        return _recite(np.clip(walk, -1, 1))


@dataclass(frozen=True)
class Heuristic:
    """The task's hand-written policy."""

    kind: ClassVar[str] = "heuristic"
    open_loop: ClassVar[bool] = False

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Nothing is drawn."""
        return HEURISTICS[task.name]


POLICIES = {policy.kind: policy for policy in (Uniform, Heuristic, Constant, OrnsteinUhlenbeck)}


def parse_policy(text: str) -> Policy:
    """A policy as people write it: `uniform`, `constant:drive=0.5`.

    Raises:
        InputError: as `make_policy` does.
    """
    kind, _, constants = text.partition(":")
    pairs = (pair.partition("=") for pair in constants.split(",") if pair)
    return _make(kind, {name.strip(): value for name, _, value in pairs})


def make_policy(settings: Mapping[str, Any]) -> Policy:
    """The policy of those settings, as a manifest has them.

    Raises:
        InputError: an unknown policy, a constant that it doesn't have, or one out of range.
    """
    constants = {name: value for name, value in settings.items() if name != "kind"}
    return _make(settings["kind"], constants)


def _make(kind: str, constants: dict[str, Any]) -> Policy:
    policy = choose(kind, POLICIES, "policy")
    known = [field.name for field in fields(policy)]
    for name, value in constants.items():
        if name not in known:
            raise InputError(
                f"policy {kind} has no constant {name!r}: "
                f"{'it has ' + ', '.join(known) if known else 'it has none'}"
            )
        try:
            constants[name] = float(value) + 0.0  # -0 is 0
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"policy {kind}: {name} is {value!r}, a number is expected, as in "
                "constant:drive=0.5"
            ) from None
    return policy(**constants)


def policy_settings(policy: Policy) -> dict[str, Any]:
    """What makes the policy again."""
    return {"kind": policy.kind, **asdict(policy)}  # type: ignore[call-overload]
