"""Policies to collect with, each determined by its kind and a few constants."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Protocol

import numpy as np

from jbrep.errors import InputError, choose
from jbrep.jitterbug.episodes import Actor as Actor
from jbrep.jitterbug.episodes import open_loop
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, EPISODE_STEPS, Task

_MAX_SIGMA = 1e6  # far beyond what alternates between full drives


class Policy(Protocol):
    """How actions are chosen; a frozen dataclass of its constants."""

    kind: ClassVar[str]
    open_loop: ClassVar[bool]  # whether actions don't depend on what is observed

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Act in n new episodes, drawing from each one's generator only."""


@dataclass(frozen=True)
class Uniform:
    """Uniformly random drives in [-1, 1], a new one for each step."""

    kind: ClassVar[str] = "uniform"
    open_loop: ClassVar[bool] = True

    def begin(self, task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
        """Draw all actions of the episodes."""
        return open_loop(np.stack([r.uniform(-1, 1, (EPISODE_STEPS, 1)) for r in randoms], axis=1))


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
    """An Ornstein-Uhlenbeck process that starts at its mean, clipped to [-1, 1].

    dx = theta (mu - x) dt + sigma dW, in steps of the control timestep (Uhlenbeck and Ornstein,
    1930); its stationary standard deviation is sigma / sqrt(2 theta).
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
        drives = np.empty_like(noise)
        drive = np.full_like(noise[0], self.mu)
        for step, increment in enumerate(noise):
            drives[step] = drive
            drive = drive + self.theta * CONTROL_TIMESTEP * (self.mu - drive)
            drive = drive + self.sigma * np.sqrt(CONTROL_TIMESTEP) * increment
        return open_loop(np.clip(drives, -1, 1))


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
    """Make a policy from text such as `uniform` or `constant:drive=0.5`.

    Raises:
        InputError: as `make_policy` does.
    """
    kind, _, constants = text.partition(":")
    pairs = (pair.partition("=") for pair in constants.split(",") if pair)
    return _make(kind, {name.strip(): value for name, _, value in pairs})


def make_policy(settings: Mapping[str, Any]) -> Policy:
    """Make a policy from its settings, as in a manifest.

    Raises:
        InputError: an unknown policy, an unknown constant, or one out of range.
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
                f"policy {kind}: {name} is {value!r}, but must be a number, as in "
                "constant:drive=0.5"
            ) from None
    return policy(**constants)


def policy_settings(policy: Policy) -> dict[str, Any]:
    """The settings that `make_policy` takes."""
    return {"kind": policy.kind, **asdict(policy)}  # type: ignore[call-overload]
