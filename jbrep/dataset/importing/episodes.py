"""Episodes that were made elsewhere, one by one, each checked."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.schema import UNKNOWN_SEED
from jbrep.envs.task import Feature, Task
from jbrep.errors import InputError

Array = NDArray[Any]
WIDE = ("observation", "action", "next_observation", "final_observation")  # with many numbers a row
_WHOLE = ("episode", "step", "seed")
_IMAGE_AXES = 3  # height, width, colour


class Incoming(NamedTuple):
    """An episode of n steps."""

    observation: NDArray[np.float32]  # (n, d), before each action
    action: NDArray[np.float32]  # (n, k)
    reward: NDArray[np.float32]  # (n,)
    final: NDArray[np.float32]  # (d,), after the last action
    terminated: bool
    seed: int


@dataclass(frozen=True)
class Source:
    """Data that were made elsewhere.

    Attributes:
        name: for messages and provenance.
        label: for a task made from the data alone: its id.
        episodes: reads them, from the first one on at each call.
        task: that the source names; None if it names none that is known here.
        features: for a task made from the data alone; numbered if there are none.
        action_bounds: lower and upper ones, (k,) each; infinite where there are none.
        max_episode_steps: for a task made from the data alone; the longest episode if None.
        why_no_task: for the user.
        rows: how many there are, if that is known.
    """

    name: str
    label: str
    episodes: Callable[[], Iterator[Incoming]]
    task: Task | None = None
    features: tuple[Feature, ...] = ()
    action_bounds: tuple[Array, Array] | None = None
    max_episode_steps: int | None = None
    why_no_task: str = "it names no environment"
    rows: int | None = None


def incoming(
    where: str,
    observation: Array,
    action: Array,
    reward: Array,
    final: Array | None,
    terminated: bool,
    seed: int = UNKNOWN_SEED,
) -> Incoming | None:
    """Check an episode's numbers.

    Without the observation after its last action, the last step is left out, so that the
    observation before that becomes the final one: nothing is made up. What ended the episode came
    after it, so the episode counts as truncated then.

    Args:
        where: it is, for messages.
        observation: (n, ...), before each action; made flat.
        action: (n, ...).
        reward: (n,).
        final: as an observation, after the last action; None if it isn't known.
        terminated: whether a state ended the episode.
        seed: that it was started with.

    Returns:
        The episode; None if no step is left.

    Raises:
        InputError: numbers that aren't finite, or too large for 32 bits.
    """
    if not len(observation):
        return None
    rows = _single(where, "observation", observation)
    if final is None:
        rows, last, terminated = rows[:-1], rows[-1], False
    else:
        last = _single(where, "final observation", np.asarray(final)[None])[0]
    if not len(rows):
        return None
    if len(last) != rows.shape[1]:
        raise InputError(
            f"{where} has {rows.shape[1]} numbers in an observation, and {len(last)} in its final "
            "one: they must be as many"
        )
    if not UNKNOWN_SEED <= seed < 1 << 63:
        raise InputError(f"{where} has the seed {seed}: it must be from 0 to 2**63 - 1, or -1")
    actions = _single(where, "action", action[: len(rows)])
    rewards = _single(where, "reward", reward[: len(rows)])[:, 0]
    return Incoming(rows, actions, rewards, last, terminated, seed)


def _single(where: str, what: str, values: Array) -> NDArray[np.float32]:
    """Flat rows of single precision, (n, ...) to (n, m)."""
    with np.errstate(over="ignore"):
        single = values.reshape(len(values), math.prod(values.shape[1:])).astype(np.float32)
    if not np.isfinite(single).all():
        step = np.flatnonzero(~np.isfinite(single).all(axis=1))[0]
        raise InputError(
            f"{where} has a number in its {what} that isn't finite, or beyond 32 bits, at step "
            f"{step}: correct the data, or leave the episode out"
        )
    return single


def flags(where: str, name: str, values: Array) -> NDArray[np.bool_]:
    """Whether each row is such an end.

    Raises:
        InputError: a value is neither 0 nor 1.
    """
    if not np.isin(values, (0, 1)).all():
        raise InputError(f"{where} has a {name} that is neither true nor false, 0 nor 1")
    return values.astype(bool)


def check_kinds(name: str, columns: Mapping[str, tuple[np.dtype[Any], Sequence[int]]]) -> None:
    """Make sure that columns hold what can be imported.

    Args:
        name: of the source.
        columns: the type, and the shape of a row, of each.

    Raises:
        InputError: objects, text, images, discrete actions, or several numbers where one belongs.
    """
    for what, (dtype, row) in columns.items():
        shape = f"{what}s of shape {tuple(row)}"
        if dtype.kind not in "fiub":
            raise InputError(
                f"{name} has {what}s of type {dtype}: they must be arrays of plain numbers"
            )
        if what not in WIDE and math.prod(row) != 1:
            raise InputError(f"{name} has {shape} in each row: it must be one number")
        if len(row) >= _IMAGE_AXES or (len(row) > 1 and dtype == np.uint8):
            raise InputError(f"{name} has images, {shape}: only features are possible")
        if math.prod(row) == 0:
            raise InputError(f"{name} has {shape}: there must be at least one number")
        if what in _WHOLE and dtype.kind not in "iu":
            raise InputError(f"{name} has {what}s of type {dtype}: they must be whole numbers")
        if what == "action" and dtype.kind != "f":
            raise InputError(
                f"{name} has actions of type {dtype}: only continuous ones are possible, floats"
            )
