"""Policies to collect with: by a kind and a few constants, or a user's own."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from jbrep.dataset.schema import episode_part
from jbrep.dataset.settings import MIXTURE
from jbrep.envs.names import code_named, digest_of, is_code, with_digest
from jbrep.envs.recording import Actor as Actor
from jbrep.envs.recording import open_loop
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError, choose, refusing
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.tasks import jitterbug_task
from jbrep.records.record import Record, from_plain, to_plain

_Drive = Annotated[float, Meta(ge=-1, le=1)]  # from the lower bound to the upper
_MAX_WEIGHT = 1e12
_BLOCK = 1000  # steps that actions are drawn for at a time


class Policy(Protocol):
    """How actions are chosen; it can be pickled, for workers."""

    def files(self) -> dict[str, bytes]:
        """The files without which it can't act again, by their names in the data set's folder."""

    def settings(self) -> dict[str, Any]:
        """What determines it, as plain JSON: its kind and its constants."""

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        """Act in n new episodes with these seeds; what is drawn depends on each one's alone."""


def generators(task: Task, seeds: Sequence[int]) -> list[np.random.Generator]:
    """A policy's random generator for each episode.

    It is NumPy's default one with the episode's seed, beyond the numbers that the environment
    draws from its own: after them where they are known, else after `PCG64.jumped`.
    """
    streams = [np.random.PCG64(seed) for seed in seeds]
    if task.draws is None:
        return [np.random.Generator(stream.jumped()) for stream in streams]
    return [np.random.Generator(stream.advance(task.draws)) for stream in streams]


class Constants(Record, frozen=True):
    """The base of policies that are records of their constants."""

    kind: ClassVar[str]
    open_loop: ClassVar[bool] = True  # whether actions don't depend on what is observed

    def files(self) -> dict[str, bytes]:
        return {}

    def settings(self) -> dict[str, Any]:
        return {"kind": self.kind, **to_plain(self)}


class Uniform(Constants, frozen=True):
    """Uniformly random actions within the bounds, a new one for each step."""

    kind: ClassVar[str] = "uniform"

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        randoms, shape = generators(task, seeds), (_BLOCK, task.action_size)

        def blocks() -> Iterator[NDArray[Any]]:
            while True:
                yield np.stack(
                    [r.uniform(task.action_low, task.action_high, shape) for r in randoms], axis=1
                )

        return _one_by_one(blocks())


class Constant(Constants, frozen=True):
    """The same action throughout."""

    kind: ClassVar[str] = "constant"
    drive: _Drive = 1.0

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        actions = task.unscale_action(np.full((len(seeds), task.action_size), self.drive))
        return lambda observation: actions


class Still(Constants, frozen=True):
    """No action at all: zero, or what the bounds have next to it."""

    kind: ClassVar[str] = "still"

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        actions = np.tile(task.rest, (len(seeds), 1))
        return lambda observation: actions


class OrnsteinUhlenbeck(Constants, frozen=True):
    """An Ornstein-Uhlenbeck process for each action, from its mean on, clipped to [-1, 1].

    dx = theta (mu - x) dt + sigma dW, in steps of the task's time step (Uhlenbeck and Ornstein,
    1930); its stationary standard deviation is sigma / sqrt(2 theta). From -1 to 1 are the bounds.
    """

    kind: ClassVar[str] = "ornstein-uhlenbeck"
    mu: _Drive = 0.0
    theta: Annotated[float, Meta(ge=0)] = 0.15  # [1/s]
    sigma: Annotated[float, Meta(ge=0, le=1e6)] = 0.3  # [1/sqrt(s)]

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        timestep, randoms = task.known_timestep, generators(task, seeds)
        if self.theta * timestep > 1:
            raise InputError(
                f"theta is {self.theta:g}: with steps of {timestep:g} s it must be in "
                f"[0, {1 / timestep:g}]"
            )
        shape = (_BLOCK, task.action_size)

        def blocks() -> Iterator[NDArray[Any]]:
            drive = np.full((len(randoms), task.action_size), self.mu)
            while True:
                noise = np.stack([r.standard_normal(shape) for r in randoms], axis=1)
                drives = np.empty_like(noise)
                for step, increment in enumerate(noise):
                    drives[step] = drive
                    drive = drive + self.theta * timestep * (self.mu - drive)
                    drive = drive + self.sigma * np.sqrt(timestep) * increment
                yield task.unscale_action(drives)

        return _one_by_one(blocks())


class Heuristic(Constants, frozen=True):
    """The task's scripted policy."""

    kind: ClassVar[str] = "heuristic"
    open_loop: ClassVar[bool] = False

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        if (own := jitterbug_task(task)) is None:
            raise InputError(
                f"{task.name} has no scripted policy: choose another policy than {self.kind}; "
                f"those that have one are {', '.join(HEURISTICS)}, with nothing hidden"
            )
        return HEURISTICS[own.name]


def _one_by_one(blocks: Iterator[NDArray[Any]]) -> Actor:
    return open_loop(action for block in blocks for action in block)


@dataclass(frozen=True)
class Mixture:
    """A policy for each episode, drawn from several with the given weights."""

    parts: tuple[tuple[float, Policy], ...]  # weights, which are positive, and policies

    def files(self) -> dict[str, bytes]:
        return {name: file for _, policy in self.parts for name, file in policy.files().items()}

    def settings(self) -> dict[str, Any]:
        return {"kind": MIXTURE, "parts": [[w, policy.settings()] for w, policy in self.parts]}

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        weights = [weight for weight, _ in self.parts]
        drawn = np.array([episode_part(seed, weights) for seed in seeds], int)
        actors: list[tuple[NDArray[np.intp], Actor]] = []
        for part, (_, policy) in enumerate(self.parts):
            indices = np.flatnonzero(drawn == part)
            actors.append((indices, policy.begin(task, [seeds[int(index)] for index in indices])))

        def act(observation: Array) -> NDArray[Any]:
            actions = np.empty((len(observation), task.action_size))
            for indices, part in actors:
                if len(indices):
                    actions[indices] = part(observation[indices])
            return actions

        return act


@dataclass(frozen=True)
class UserPolicy:
    """A user's own policy: a function, a class of functions, or a stable-baselines3 model.

    A function takes an observation (d,) and gives an action (k,). A class has an instance for each
    episode, which begins with what it remembers. Where the attribute `batched` is true, one call
    takes the observations of n episodes, (n, d), and gives their actions, (n, k), and of a class
    there is one instance for all that begin together. A model's `predict` keeps the state of a
    recurrent policy for each episode. Actions are clipped to the task's bounds.
    """

    kind: ClassVar[str] = "own"
    name: str  # module:function and a digest of it
    policy: Any = field(repr=False, compare=False)

    @classmethod
    def named(cls, code: str) -> "UserPolicy":
        """What a name of code stands for, as in mymodule:act."""
        return cls(with_digest(code, "policy"), code_named(code, "policy"))

    @classmethod
    def of(cls, policy: Any) -> "UserPolicy":
        """A function, class or model itself.

        Of a model its network is played, so it must see and do what the task says, unscaled.
        """
        if hasattr(policy, "get_vec_normalize_env"):
            env = getattr(policy.get_env(), "unwrapped", None)
            is_ours = getattr(env, "scales", False) or hasattr(policy, "action_repeat")
            if is_ours or policy.get_vec_normalize_env():
                raise InputError(
                    "the model learned on scaled observations or actions: give a run's folder, or "
                    "a function that scales both as its training did"
                )
        acting = getattr(policy, "policy", policy) if hasattr(policy, "predict") else policy
        if not (callable(acting) or hasattr(acting, "predict")):
            raise InputError(
                f"the policy is {acting!r:.80}: it must be a name, a function of an observation, a "
                "class of such functions, or a stable-baselines3 model"
            )
        kind = type(acting)
        name = f"{kind.__module__}:{kind.__qualname__}"
        if hasattr(acting, "__qualname__"):
            name = f"{acting.__module__}:{acting.__qualname__}"
        return cls(f"{name} {digest_of(acting)}", acting)

    def files(self) -> dict[str, bytes]:
        return {}

    def settings(self) -> dict[str, Any]:
        return {"kind": self.kind, "name": self.name}

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        batched = getattr(self.policy, "batched", False)
        with self._refusing():
            actors = [_acting(self.policy) for _ in range(1 if batched else len(seeds))]
        low, high = np.array(task.action_low), np.array(task.action_high)
        shape = len(seeds), task.action_size

        def act(observation: Array) -> NDArray[Any]:
            seen = observation.astype(np.float32)
            with self._refusing():
                rows = zip(actors, seen, strict=False)
                made = actors[0](seen) if batched else [each(row) for each, row in rows]
                actions = np.asarray(made, float)
            if actions.shape == shape[:1] and shape[1] == 1:
                actions = actions[:, None]
            if actions.shape != shape or not np.isfinite(actions).all():
                what, taken = ("actions", shape) if batched else ("an action", shape[1:])
                given = actions.shape if batched else actions.shape[1:]
                raise InputError(
                    f"the policy {self.name} gives {what} of shape {given}: it must be {taken}, "
                    "all finite"
                )
            return np.clip(actions, low, high)

        return act

    def _refusing(self) -> AbstractContextManager[None]:
        return refusing(f"the policy {self.name} fails")


def _acting(policy: Any) -> Callable[[NDArray[np.float32]], Any]:
    """The function that acts in an episode that begins now."""
    made = policy() if isinstance(policy, type) else policy
    if not hasattr(made, "predict"):
        return made
    state, first = None, True

    def act(observation: NDArray[np.float32]) -> Any:
        nonlocal state, first
        action, state = made.predict(observation, state, np.array([first]), deterministic=True)
        first = False
        return action

    return act


POLICIES: dict[str, type[Uniform | Still | Heuristic | Constant | OrnsteinUhlenbeck]] = {
    policy.kind: policy for policy in (Uniform, Still, Heuristic, Constant, OrnsteinUhlenbeck)
}
_WEIGHT = re.compile(r":([\d.]+(?:e-?\d+)?)\+")  # between the parts of a mixture


def parse_policy(text: str, other: Callable[[str], Policy | None] = lambda text: None) -> Policy:
    """Make a policy from text such as `constant:drive=0.5` or `uniform:0.8+heuristic:0.2`.

    For text that is none of POLICIES, `other` gives the policy, if it knows one.
    """
    if policy := other(text):
        return policy
    if not _WEIGHT.search(text):
        kind, _, constants = text.partition(":")
        if kind not in POLICIES and is_code(text):
            return UserPolicy.named(text)
        if kind not in POLICIES:
            raise InputError(
                f"unknown policy {kind!r}: choose one of {', '.join(POLICIES)}, trained, the "
                "folder of a run with a policy or checkpoint, your own as module:function, or a "
                "mixture, such as uniform:0.8+heuristic:0.2"
            )
        pairs = (pair.partition("=") for pair in constants.split(",") if pair)
        return _make(kind, {name.strip(): value for name, _, value in pairs})
    *parts, last = _WEIGHT.split(text)
    final, _, weight = last.rpartition(":")
    weights = [_weight(each) for each in (*parts[1::2], weight)]
    policies = [parse_policy(part, other) for part in (*parts[::2], final)]
    shares = [weight / math.fsum(weights) for weight in weights]
    return Mixture(tuple(zip(shares, policies, strict=True)))


def _weight(text: str) -> float:
    with suppress(ValueError):
        if 0 < (weight := float(text)) < _MAX_WEIGHT:
            return weight
    raise InputError(
        f"the weight {text!r} must be a positive number below 1e12: each part of a mixture has "
        "one, as in uniform:0.8+heuristic:0.2"
    )


def make_policy(settings: Mapping[str, Any]) -> Policy:
    """Make a policy from its kind and constants, as in a manifest."""
    if settings["kind"] == MIXTURE:
        return Mixture(tuple((w, make_policy(part)) for w, part in settings["parts"]))
    constants = {name: value for name, value in settings.items() if name != "kind"}
    return _make(settings["kind"], constants)


def _make(kind: str, constants: Mapping[str, Any]) -> Policy:
    policy = choose(kind, POLICIES, "policy")
    return from_plain({name: _number(value) for name, value in constants.items()}, policy, kind)


def _number(constant: Any) -> Any:
    """A constant as a number where it is one, or text that stands for one; -0 is 0."""
    try:
        return float(constant) + 0.0
    except (TypeError, ValueError, OverflowError):
        return constant
