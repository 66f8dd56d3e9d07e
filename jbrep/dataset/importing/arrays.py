"""Arrays in Python, of all episodes one after the other, or one for each episode."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.dataset.importing.episodes import (
    Incoming,
    Source,
    check_kinds,
    flags,
    incoming,
)
from jbrep.dataset.importing.flat import CHUNK, PerEpisode, check_columns, split
from jbrep.dataset.schema import UNKNOWN_SEED
from jbrep.errors import InputError
from jbrep.text import slug

Array = NDArray[Any]


def is_listed(rewards: Any) -> bool:
    """Whether these are the rewards of several episodes, one array for each."""
    return isinstance(rewards, (list, tuple)) and len(rewards) > 0 and np.ndim(rewards[0]) == 1


def from_flat(name: str, columns: dict[str, Any], once: dict[str, Any]) -> Source:
    """Arrays with a row for each step of all episodes.

    Args:
        name: of the source.
        columns: by their names in `ALIASES`; those that are None aren't there.
        once: what `PerEpisode` takes, likewise.

    Raises:
        InputError: arrays of different lengths, or of a kind that can't be imported.
    """
    arrays = {n: plain(name, n, v) for n, v in columns.items() if v is not None}
    check_columns(name, arrays)
    check_lengths(name, {n: len(v) for n, v in arrays.items()})
    check_kinds(name, kinds(arrays))
    known = PerEpisode.of(name, {n: plain(name, n, v) for n, v in once.items() if v is not None})
    rows = len(arrays["reward"])

    def episodes() -> Iterator[Incoming]:
        starts = range(0, rows, CHUNK)
        chunks = ({n: v[start : start + CHUNK] for n, v in arrays.items()} for start in starts)
        return split(name, chunks, known)

    return Source(name, label(name), episodes, rows=rows)


def from_list(name: str, columns: dict[str, Any], once: dict[str, Any]) -> Source:
    """Arrays with a row for each step of one episode, in lists with an entry for each episode.

    An episode's observations may have one row more than the rest: the final observation.

    Raises:
        InputError: lists of different lengths.
    """
    given = {n: v for n, v in {**columns, **once}.items() if v is not None}
    check_columns(name, given)
    check_lengths(name, {n: len(v) for n, v in given.items()}, "episodes")
    if "seed" in given:
        given["seed"] = PerEpisode.of(name, {"seed": plain(name, "seed", given["seed"])}).seed

    def episodes() -> Iterator[Incoming]:
        for number in range(len(given["reward"])):
            here = {n: v[number] for n, v in given.items()}
            episode = _listed(f"{name}: episode {number}", here)
            if episode is not None:
                yield episode

    return Source(name, label(name), episodes, rows=sum(map(len, given["reward"])))


def _listed(where: str, given: dict[str, Any]) -> Incoming | None:
    seed = int(given.pop("seed", UNKNOWN_SEED))
    final = given.pop("final_observation", None)
    arrays = {n: plain(where, n, v) for n, v in given.items()}
    observation = arrays["observation"]
    if len(observation) == len(arrays["reward"]) + 1 and final is None:
        arrays["observation"], final = observation[:-1], observation[-1]
    check_lengths(where, {n: len(v) for n, v in arrays.items()})
    last = {} if final is None else {"final_observation": np.asarray(final)[None]}
    check_kinds(where, kinds({**arrays, **last}))
    ends = {n: flags(where, n, arrays[n]) for n in ("terminated", "truncated") if n in arrays}
    check_ends(where, *ends.values())
    return incoming(
        where,
        arrays["observation"],
        arrays["action"],
        arrays["reward"],
        None if final is None else np.asarray(final),
        bool(ends["terminated"][-1:].any()) if "terminated" in ends else False,
        seed,
    )


def check_ends(where: str, *flags: Array) -> None:
    """Make sure that only the last row of an episode is an end.

    Raises:
        InputError: an earlier one is.
    """
    for is_end in flags:
        if is_end[:-1].any():
            step = np.flatnonzero(is_end)[0]
            raise InputError(f"{where} goes on after its end at step {step}: divide it there")


def plain(name: str, what: str, values: ArrayLike) -> Array:
    """An array with rows.

    Raises:
        InputError: no such array.
    """
    try:
        array = np.asarray(values)
    except ValueError:
        raise InputError(
            f"{name} has {what}s of different sizes: they must make one array"
        ) from None
    if not array.ndim:
        raise InputError(f"{name} has a single {what}: it must be an array")
    return array


def kinds(arrays: Mapping[str, Array]) -> dict[str, tuple[np.dtype[Any], tuple[int, ...]]]:
    """The type, and the shape of a row, of each array."""
    return {name: (values.dtype, values.shape[1:]) for name, values in arrays.items()}


def check_lengths(name: str, lengths: dict[str, int], unit: str = "rows") -> None:
    """Make sure that all arrays are equally long.

    Raises:
        InputError: two differ.
    """
    (first, expected), *others = lengths.items()
    for what, length in others:
        if length != expected:
            raise InputError(
                f"{name} has {expected:,} {unit} of {first}s, and {length:,} of {what}s: they must "
                "be as many"
            )


def label(name: str) -> str:
    """A name as the id of a task: of letters, digits, '.', '_' and '-'."""
    return slug(name).strip("-.")[:100] or "imported"


def source_of(columns: dict[str, Any], once: dict[str, Sequence[Any] | None], name: str) -> Source:
    """Arrays of either kind, see `Dataset.write`."""
    return (from_list if is_listed(columns["reward"]) else from_flat)(name, columns, once)
