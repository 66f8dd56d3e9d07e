"""Rows of many episodes, one after the other, divided into episodes; and arrays in Python."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import (
    ALIASES,
    ENDS,
    WIDE,
    Incoming,
    Rows,
    Source,
    check_arrays,
    check_lengths,
    check_names,
    checked,
    flags,
    label,
    plain,
    whole_episode,
)
from jbrep.dataset.schema import joined
from jbrep.envs.task import MAX_EPISODE_STEPS, Feature
from jbrep.errors import InputError
from jbrep.text import words

Array = NDArray[Any]

CHUNK = 1 << 14  # rows read at a time


def per_episode(name: str, given: Mapping[str, Any]) -> dict[str, Array]:
    """What a source knows once for each episode, checked.

    Args:
        name: of the source.
        given: final_observation (episodes, ...), terminated, truncated and seed (episodes,), as far
            as they are known.
    """
    arrays = {what: plain(name, what, values) for what, values in given.items()}
    check_arrays(name, arrays, "episodes")
    return {what: narrow(what, values) for what, values in arrays.items()}


def own_names(name: str, names: Collection[str]) -> dict[str, str]:
    """Which of a source's names stand for which column.

    Args:
        name: of the source.
        names: that it has.
    """
    own: dict[str, str] = {}
    for column, aliases in ALIASES.items():
        present = [alias for alias in aliases if alias in names]
        if len(present) > 1:
            raise InputError(f"{name} has {' and '.join(present)}: keep one of them")
        if present:
            own[column] = present[0]
    return own


def split(
    name: str,
    chunks: Iterable[Rows],
    known: Mapping[str, Array],
    most: int = MAX_EPISODE_STEPS,
    parts: Callable[[Rows], Iterable[Rows]] = lambda rows: (rows,),
) -> Iterator[Incoming]:
    """Divide rows into episodes, in bounded memory.

    An episode ends where it is terminated or truncated, before another episode's number or a
    step 0, and at the end of the rows.

    Args:
        name: of the source.
        chunks: of rows, in order.
        known: once for each episode, as of `per_episode`.
        most: rows of an episode.
        parts: makes episodes of the rows of one.
    """
    count, numbers = 0, set[int]()
    for rows in _divided(name, chunks, most):
        number = int(rows["episode"][0]) if "episode" in rows else count
        if number in numbers:
            raise InputError(
                f"{name}: episode {number} goes on after its end, or comes in two parts: the "
                "rows of an episode must stand together, and only its last one be an end"
            )
        numbers.add(number)
        if few := [what for what, values in known.items() if count >= len(values)]:
            raise InputError(
                f"{name} has a {few[0]} for {len(known[few[0]]):,} episodes, and more episodes"
            )
        several, ends = list(parts(rows)), {what: values[count] for what, values in known.items()}
        starts = {"seed": ends.pop("seed")} if "seed" in ends else {}
        for i, part in enumerate(several):
            of_part = (starts if i == 0 else {}) | (ends if i == len(several) - 1 else {})
            yield from checked(f"{name}: episode {number}", part, of_part)
        count += 1
    for what, values in known.items():
        if len(values) != count:
            raise InputError(
                f"{name} has a {what} for {len(values):,} episodes, but {count:,} episodes: the "
                "two must be equal"
            )


def _divided(name: str, chunks: Iterable[Rows], most: int) -> Iterator[Rows]:
    """The rows of each episode."""
    begun: list[Rows] = []
    for given in chunks:
        chunk, begin = {n: narrow(n, values) for n, values in given.items()}, 0
        for end in _ends(name, begun[-1:], chunk):
            yield joined([*begun, _some(chunk, begin, end)])
            begun, begin = [], end
        if begin < len(chunk["action"]):
            begun.append(_some(chunk, begin, None))
        if sum(len(rows["action"]) for rows in begun) > most:
            raise InputError(
                f"{name} has an episode of more than {most:,} steps: does something tell where it "
                "ends?"
            )
    if begun:
        yield joined(begun)


def _some(rows: Rows, begin: int, end: int | None) -> Rows:
    return {n: values[begin:end] for n, values in rows.items()}


def narrow(name: str, values: Array) -> Array:
    """A column without the axis of width 1 that some give to what is one number a row."""
    return values if name in WIDE else values.reshape(len(values))


def _ends(name: str, before: list[Rows], rows: Rows) -> list[int]:
    """Before which of the rows an episode ends; maybe before the first, after those before."""
    is_end = np.zeros(len(rows["action"]) + 1, dtype=bool)
    for flag in ENDS:
        if flag in rows:
            is_end[1:] |= flags(name, flag, rows[flag])
    number = "episode" if "episode" in rows else "step"
    if number in rows:
        last = [each[number][-1:] for each in before]
        numbers = np.concatenate([*last, rows[number]])
        begins = numbers[1:] != numbers[:-1] if number == "episode" else numbers[1:] == 0
        is_end[len(is_end) - 1 - len(begins) : -1] |= begins
    return [int(row) for row in np.flatnonzero(is_end)]


def source_of(columns: Mapping[str, Any], once: Mapping[str, Any], name: str) -> Source:
    """Arrays in Python, see `from_arrays`.

    Args:
        columns: by their names in `ALIASES`: a row for each step of all episodes, or a list with
            such an array for each episode; those that are None aren't there.
        once: what `per_episode` takes, likewise.
        name: of the source.
    """
    given = {what: values for what, values in columns.items() if values is not None}
    known = {what: values for what, values in once.items() if values is not None}
    check_names(name, given)
    single = next(given[what] for what in ("reward", *ENDS) if what in given)
    if isinstance(single, list | tuple) and len(single) and np.ndim(single[0]) == 1:
        return _listed(name, given, known)
    arrays = {what: plain(name, what, values) for what, values in given.items()}
    rows = len(arrays["action"])
    check_arrays(name, arrays)
    checked_once = per_episode(name, known)

    def episodes() -> Iterator[Incoming]:
        starts = range(0, rows, CHUNK)
        chunks = ({n: v[start : start + CHUNK] for n, v in arrays.items()} for start in starts)
        return split(name, chunks, checked_once)

    features, has_rewards = _named(columns["observation"]), "reward" in given
    return Source(
        name, label(name), episodes, features=features, rows=rows, has_rewards=has_rewards
    )


def _named(observations: Any) -> tuple[Feature, ...]:
    """The features that the columns of a data frame name; none of an array, or of bare numbers."""
    names = [*getattr(observations, "columns", ())]
    if not all(isinstance(each, str) for each in names):
        return ()
    return tuple(map(Feature, words(names)))


def _listed(name: str, columns: Mapping[str, Any], once: dict[str, Any]) -> Source:
    """Lists of arrays, one for each episode."""
    check_lengths(name, {n: len(values) for n, values in {**columns, **once}.items()}, "episodes")
    if "seed" in once:
        once |= per_episode(name, {"seed": once["seed"]})

    def episodes() -> Iterator[Incoming]:
        for number in range(len(columns["action"])):
            own, ends = (
                {what: values[number] for what, values in each.items()} for each in (columns, once)
            )
            yield from whole_episode(f"{name}: episode {number}", own, **ends)

    features, has_rewards = _named(next(iter(columns["observation"]), None)), "reward" in columns
    rows = sum(map(len, columns["action"]))
    return Source(
        name, label(name), episodes, features=features, rows=rows, has_rewards=has_rewards
    )
