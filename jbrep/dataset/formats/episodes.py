"""Episodes that were made elsewhere, one by one, each checked."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.dataset.schema import UNKNOWN_SEED
from jbrep.envs.task import MAX_FEATURES, Feature, Task
from jbrep.errors import InputError, listed
from jbrep.records.record import MOST_WHOLE
from jbrep.text import slug

Array = NDArray[Any]
Rows = Mapping[str, Array]  # arrays with a row for each step, by the names of ALIASES

ALIASES = {  # what others call the columns; the dotted and the last ones are LeRobot's
    "observation": ("observation", "observations", "observation.state"),
    "action": ("action", "actions"),
    "reward": ("reward", "rewards", "next.reward"),
    "terminated": ("terminated", "terminations", "terminals"),
    "truncated": ("truncated", "truncations", "timeouts"),
    "next_observation": ("next_observation", "next_observations"),
    "episode": ("episode", "episode_index"),
    "step": ("step", "frame_index"),
}
ENDS = ("terminated", "truncated")
WIDE = ("observation", "action", "next_observation", "final_observation")  # with many numbers a row
WHOLE = ("episode", "step", "seed")
CLOCKS = 0.01  # by which even clocks may differ and count as alike
_IMAGE_AXES = 3  # height, width, colour


class Incoming(NamedTuple):
    """An episode of n steps; numbers may be missing."""

    where: str  # it is, for messages
    observation: NDArray[np.float64]  # (n, d), before each action
    action: NDArray[np.float64]  # (n, k)
    reward: NDArray[np.float64]  # (n,), 0 where none is known
    final: NDArray[np.float64]  # (d,), after the last action
    terminated: bool
    seed: int
    missing: int = 0  # numbers in whose place are others, or at which it was divided
    truncated: bool = False  # also where it was terminated; else it counts as truncated anyway
    is_cut: bool = False  # whether its last step was left out, for want of a final observation


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
        has_rewards: whether they are known.
        subtracted: offsets of features that observations lack already, (d,) or 0.
        timestep: for a task made from the data alone [s].
        notes: what is done to its columns, for the user.
        changes: what was done to the rows that were read last, how often: what it is, and what
            became of it.
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
    has_rewards: bool = True
    subtracted: Array | float = 0.0
    timestep: float | None = None
    notes: tuple[str, ...] = ()
    changes: Callable[[], Mapping[tuple[str, str], int]] = dict


def label(name: str) -> str:
    """A name as the id of a task: of letters, digits, '.', '_' and '-'."""
    return slug(name).strip("-.")[:100] or "imported"


def whole_episode(where: str, given: Mapping[str, ArrayLike], **once: Any) -> Iterator[Incoming]:
    """An episode from arrays of all its steps; none if no step is left.

    Args:
        where: it is, for messages.
        given: by the names of ALIASES; observations may have one row more than the rest: the final
            one.
        once: the final observation and the seed, where they are known.
    """
    arrays = {name: plain(where, name, values) for name, values in given.items()}
    observation = arrays["observation"]
    if len(observation) == len(arrays["action"]) + 1 and "final_observation" not in once:
        arrays["observation"], once["final_observation"] = observation[:-1], observation[-1]
    check_arrays(where, arrays)
    if "final_observation" in once:
        check_arrays(where, {"final_observation": np.asarray(once["final_observation"])[None]})
    for name in ENDS:
        is_end = flags(where, name, arrays[name]) if name in arrays else np.zeros(0, bool)
        if is_end[:-1].any():
            step = np.flatnonzero(is_end)[0]
            raise InputError(f"{where} goes on after its end at step {step}: divide it there")
    yield from checked(where, arrays, once)


def checked(where: str, rows: Rows, once: Mapping[str, Any]) -> Iterator[Incoming]:
    """An episode, its parts checked; none if no step is left.

    Without the observation after its last action, the last step is left out, so that the
    observation before that becomes the final one: nothing is made up. What ended the episode came
    after it, so the episode counts as truncated then.

    Args:
        where: it is, for messages.
        rows: of its steps.
        once: its final observation, how it ended and its seed, where they are known.
    """
    if not len(rows["action"]):
        return
    _check_steps(where, rows)
    for name in {*WIDE} & rows.keys():
        check_whole(rows[name], f"{where}, step {{}}: the {name.replace('_', ' ')}".format)
    following = _following(where, rows)
    final = once.get("final_observation", following)
    observation = _flat(rows["observation"])
    ended = {name: rows[name][-1] for name in ENDS if name in rows} | {**once}
    terminated, truncated = (bool(ended.get(name, False)) for name in ENDS)
    if final is None:
        observation, last, terminated = observation[:-1], observation[-1], False
    else:
        last = _flat(np.asarray(final)[None])[0]
    steps = len(observation)
    if not steps:
        return
    if len(last) != observation.shape[1]:
        raise InputError(
            f"{where} has {observation.shape[1]} numbers in an observation, and {len(last)} in its "
            "final one: the two must be equal"
        )
    seed = int(once.get("seed", UNKNOWN_SEED))
    if not UNKNOWN_SEED <= seed < 1 << 63:
        raise InputError(f"{where} has the seed {seed}: it must be from 0 to 2**63 - 1, or -1")
    action = _flat(rows["action"][:steps])
    reward = _flat(rows["reward"][:steps])[:, 0] if "reward" in rows else np.zeros(steps)
    is_cut = final is None
    how = {"terminated": terminated, "truncated": truncated, "is_cut": is_cut}
    yield Incoming(where, observation, action, reward, last, seed=seed, **how)


def _check_steps(where: str, rows: Rows) -> None:
    """The steps of an episode are numbered without a gap, from 0."""
    if "step" not in rows:
        return
    wrong = np.flatnonzero(rows["step"] != np.arange(len(rows["step"])))
    if len(wrong):
        first = wrong[0]
        raise InputError(
            f"{where} has step {rows['step'][first]} where step {first} was expected: its steps "
            "must be numbered from 0 without a gap"
        )


def _following(where: str, rows: Rows) -> Array | None:
    """The observation after the last action, if that is known."""
    if "next_observation" not in rows:
        return None
    after, before = (
        _flat(each) for each in (rows["next_observation"][:-1], rows["observation"][1:])
    )
    apart = (after.astype(np.float32) != before.astype(np.float32)) & ~(
        np.isnan(after) & np.isnan(before)
    )
    if apart.any():
        step = np.argwhere(apart)[0, 0]
        raise InputError(
            f"{where} has a gap after step {step}: the observation after that step isn't the one "
            "before the next"
        )
    last: Array = rows["next_observation"][-1]
    return last


def check_whole(values: Array, told: Callable[[int], str]) -> None:
    """Refuse whole numbers that floats of 64 bits don't hold.

    Args:
        values: with rows.
        told: where they stand and what they are called, by the number of a row.
    """
    if values.dtype.kind not in "iu":
        return
    beyond = (values > MOST_WHOLE) | (values < -MOST_WHOLE)
    if beyond.any():
        first = np.argwhere(beyond)[0]
        raise digits_lost(told(int(first[0])), int(values[tuple(first)]))


def digits_lost(told: str, number: int) -> InputError:
    """That a whole number is beyond `MOST_WHOLE`; told is where it stands and what it is called."""
    return InputError(
        f"{told} is {number}: whole numbers beyond 2**53 lose digits; subtract something from the "
        "column first, or leave it out"
    )


def _flat(values: Array) -> NDArray[np.float64]:
    """Flat rows, (n, ...) to (n, m)."""
    return values.reshape(len(values), math.prod(values.shape[1:])).astype(np.float64)


def single(where: str, what: str, values: NDArray[np.float64]) -> NDArray[np.float32]:
    """Numbers in single precision."""
    with np.errstate(over="ignore"):
        rounded = values.astype(np.float32)
    if not np.isfinite(rounded).all():
        step = np.argwhere(~np.isfinite(rounded))[0, 0]
        raise InputError(
            f"{where} has a number in its {what} that isn't finite, or beyond 32 bits, at step "
            f"{step}: correct the data, leave the episode out, or give --missing"
        )
    return rounded


def plain(name: str, what: str, values: ArrayLike) -> Array:
    """An array with rows."""
    try:
        array = np.asarray(values)
    except ValueError:
        raise InputError(
            f"{name} has {what}s of different sizes: they must make one array"
        ) from None
    if not array.ndim:
        raise InputError(f"{name} has a single {what}: it must be an array")
    return array


def flags(where: str, name: str, values: Array) -> NDArray[np.bool_]:
    """Whether each row is such an end."""
    if not np.isin(values, (0, 1)).all():
        raise InputError(f"{where} has a {name} that is neither true nor false, 0 nor 1")
    return values.astype(bool)


def check_names(name: str, roles: Iterable[str], columns: Iterable[str] = ()) -> None:
    """Make sure that there is what every data set needs.

    Args:
        name: of the source, for messages, as are its columns, unless they are named as roles.
        roles: that columns have.
        columns: all that there are.
    """
    roles = set(roles)
    for needed in ("observation", "action"):
        if needed not in roles:
            has = listed([*columns] or sorted(roles)) or "no columns"
            raise InputError(
                f"{name} has no {needed}s: of a log name their columns, as in --actions torque "
                f"--observations 'joint_*'; it has {has}"
            )
    if not roles & {*ENDS, "episode", "step"}:
        raise InputError(
            f"{name} doesn't tell where an episode ends: give it terminations and truncations, or "
            "the number of the episode in each row; of a log name the column of times or episodes "
            "(--time, --episode), or give the --length"
        )


def check_lengths(name: str, lengths: Mapping[str, int], unit: str = "rows") -> None:
    """Make sure that all columns are equally long."""
    first, expected = next(iter(lengths.items()), ("", 0))
    for what, length in lengths.items():
        if length != expected:
            raise InputError(
                f"{name} has {expected:,} {unit} of {first}s, and {length:,} of {what}s: the "
                "two must be equal"
            )


def check_arrays(name: str, arrays: Mapping[str, Any], unit: str = "rows") -> None:
    """`check_lengths` and `check_kind` of arrays, or of what has their types and shapes."""
    check_lengths(name, {what: (*each.shape, 0)[0] for what, each in arrays.items()}, unit)
    for what, each in arrays.items():
        check_kind(name, what, each.dtype, each.shape[1:])


def check_kind(name: str, what: str, dtype: np.dtype[Any], row: Sequence[int] = ()) -> None:
    """Make sure that a column holds what can be imported.

    Args:
        name: of the source.
        what: the column.
        dtype: of its values.
        row: shape of one of its rows.
    """
    shape = f"{what}s of shape {tuple(row)}"
    if dtype.kind not in "fiub":
        raise InputError(
            f"{name} has {what}s of type {dtype}: they must be arrays of plain numbers"
        )
    if what not in WIDE and math.prod(row) != 1:
        raise InputError(f"{name} has {shape} in each row: it must be one number")
    if len(row) >= _IMAGE_AXES or (len(row) > 1 and dtype == np.uint8):
        raise InputError(f"{name} has images, {shape}: only features are possible")
    if math.prod(row) > MAX_FEATURES:
        raise InputError(f"{name} has {shape}: at most {MAX_FEATURES:,} numbers are possible")
    if math.prod(row) == 0:
        raise InputError(f"{name} has {shape}: there must be at least one number")
    if what in WHOLE and dtype.kind not in "iu":
        raise InputError(f"{name} has {what}s of type {dtype}: they must be whole numbers")
    if what == "action" and dtype.kind != "f":
        raise InputError(
            f"{name} has actions of type {dtype}: only continuous ones are possible, floats"
        )
