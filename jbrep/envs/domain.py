"""What differs from episode to episode: the robot's body and physics, its sensors and motors."""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta, structs
from numpy.typing import NDArray

from jbrep.errors import InputError, choose
from jbrep.records.record import Finite, Record, converted

Array = NDArray[np.float64]

_STREAM = 0x646F6D61696E  # nothing else draws from the streams (_STREAM, seed, ...)
_BLOCK = 100  # steps whose numbers are drawn at once
_PUSHES = 0.01  # in a step, on average
_LATEST = 100  # [steps]

_Positive = Annotated[float, Meta(ge=0, le=1000)]
_Factor = Annotated[float, Meta(ge=0.01, le=100)]
_Share = Annotated[float, Meta(ge=0, le=1)]
_Steps = Annotated[int, Meta(ge=0, le=_LATEST)]
_Body = Annotated[int, Meta(ge=0, le=(1 << 31) - 1)]


class Drawn(NamedTuple):
    """What an episode has, of each name that a domain has."""

    noise: float
    delay: int
    dropped: float
    action_delay: int
    friction: float
    mass: float
    push: float
    body: int | None  # None for the robot's own


NAMES = Drawn._fields
SIGNALS = NAMES[:4]  # what any environment can have
PHYSICS = NAMES[4:7]  # what one with MuJoCo can have, too


class Domain(Record, frozen=True):
    """Ranges, ends included, from which each episode draws by its seed; equal ends fix a number.

    What an episode draws of one doesn't depend on the others.

    Args:
        noise: standard deviation of what is added to each feature, as a share of its `spread`.
        delay: by which observations are late [steps]; until then, the first one is seen.
        dropped: share of observations that don't arrive: the last one that did is seen again.
        action_delay: by which actions are late [steps]; until then, the robot is at rest.
        friction: of all contacts, times that of the model.
        mass: of all bodies, with their inertias, likewise.
        push: an impulse on the root body in a random horizontal direction, in a hundredth of all
            steps: the velocity that the whole robot would get if nothing held it [m/s].
        body: the number of the Jitterbug's; None for that of the environment's arguments.
        spread: of each feature that the environment gives, (D,): its standard deviation in episodes
            of random actions.
    """

    noise: tuple[_Positive, _Positive] = (0.0, 0.0)
    delay: tuple[_Steps, _Steps] = (0, 0)
    dropped: tuple[_Share, _Share] = (0.0, 0.0)
    action_delay: tuple[_Steps, _Steps] = (0, 0)
    friction: tuple[_Factor, _Factor] = (1.0, 1.0)
    mass: tuple[_Factor, _Factor] = (1.0, 1.0)
    push: tuple[_Positive, _Positive] = (0.0, 0.0)
    body: tuple[_Body, _Body] | None = None
    spread: tuple[Finite, ...] = ()

    def check(self) -> None:
        for name in NAMES:
            ends = getattr(self, name)
            if ends and ends[0] > ends[1]:
                raise InputError(f"{name} is {ends[0]}..{ends[1]}: swap them")
        if self.noise[1] and not self.spread:
            raise InputError("noise is a share of each feature's spread, which is missing")

    @property
    def physics(self) -> "Domain | None":
        """The part of it that the environment itself must know; None if there is none."""
        own = {name: e for name, e in self._differing.items() if name not in SIGNALS}
        return Domain(**own) if own else None

    def draw(self, seed: int) -> Drawn:
        """What the episode with that seed has."""
        at = np.random.default_rng((_STREAM, seed)).random(len(NAMES)).tolist()
        return Drawn(*(_between(getattr(self, n), u) for n, u in zip(NAMES, at, strict=True)))

    def __str__(self) -> str:
        """As people write it: noise=0.1,delay=1..3."""
        ends = {name: map("{:.12g}".format, each) for name, each in self._differing.items()}
        return ",".join(f"{name}={'..'.join(dict.fromkeys(each))}" for name, each in ends.items())

    @property
    def _differing(self) -> dict[str, Any]:
        """The ranges by name that aren't those of no domain at all."""
        usual = Domain()
        own = {name: getattr(self, name) for name in NAMES}
        return {name: ends for name, ends in own.items() if ends != getattr(usual, name)}


def _between(ends: Any, at: float) -> Any:
    """A number of a range, from one in [0, 1): whole if the ends are."""
    if ends is None:
        return None
    low, high = ends
    if isinstance(low, int):
        return low + int(at * (high - low + 1))
    return low + at * (high - low)


def read_ranges(given: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a domain from numbers and ranges as people write them: 2, "0..3" or [0, 3]."""
    kinds = {field.name: field.type for field in structs.fields(Domain) if field.name in NAMES}
    ranges = {}
    for name, value in given.items():
        kind = choose(name, kinds, "part of a domain")
        ends = [*map(str.strip, value.split(".."))] if isinstance(value, str) else value
        ends = ends if isinstance(ends, list | tuple) else [ends]
        ranges[name] = converted(ends * 2 if len(ends) == 1 else ends, kind, name, strict=False)
    return ranges


def check_ranges(given: Mapping[str, Any]) -> None:
    """Make sure that there is a domain of these, whatever the spread of the features."""
    Domain(**read_ranges(given), spread=(1.0,))


class Draws:
    """Random numbers of n episodes: those of a step follow from its number and the seed.

    Of each step they are normal ones, (n, d), and uniform ones.
    """

    def __init__(self, num_envs: int, size: int):
        self._size = size
        self._seeds = np.zeros(num_envs, np.int64)
        self._steps = np.zeros(num_envs, np.int64)  # so far, in each episode
        self._uniform = np.zeros((num_envs, _BLOCK, 3))
        self._normal = np.zeros((num_envs, _BLOCK, size))

    def begin(self, indices: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Be at the first state of new episodes in some environments."""
        self._seeds[indices], self._steps[indices] = seeds, 0
        self._fill(indices)

    def move(self) -> None:
        """Be at the next state of each environment."""
        self._steps += 1
        self._fill(np.flatnonzero(self._steps % _BLOCK == 0))

    def _fill(self, indices: NDArray[np.int64]) -> None:
        for index in indices.tolist():
            block = int(self._steps[index]) // _BLOCK
            entropy = (_STREAM, int(self._seeds[index]))
            random = np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=(block,)))
            self._uniform[index] = random.random((_BLOCK, 3))
            self._normal[index] = random.standard_normal((_BLOCK, self._size))

    @property
    def normal(self) -> Array:
        """Independent standard normal numbers of now, (n, d)."""
        return self._now(self._normal)

    @property
    def uniform(self) -> Array:
        """Numbers in [0, 1) of now, (n,)."""
        return self._now(self._uniform)[:, 0]

    def pushes(self, speeds: Array) -> Array:
        """The velocities of the pushes of now, zeros where there is none, (n, 3) [m/s].

        Each environment's pushes have its speed, (n,).
        """
        _, chance, turn = self._now(self._uniform).T
        pushed = np.where(chance < _PUSHES, speeds, 0)
        turn = 2 * np.pi * turn
        return np.stack((pushed * np.cos(turn), pushed * np.sin(turn), np.zeros_like(turn)), 1)

    def _now(self, block: Array) -> Array:
        return block[np.arange(len(block)), self._steps % _BLOCK]
