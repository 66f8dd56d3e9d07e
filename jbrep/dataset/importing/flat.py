"""Rows of many episodes, one after the other, divided into episodes."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.importing.episodes import WIDE, Incoming, check_kinds, flags, incoming
from jbrep.dataset.schema import UNKNOWN_SEED
from jbrep.envs.task import MAX_EPISODE_STEPS
from jbrep.errors import InputError

Array = NDArray[Any]
Rows = Mapping[str, Array]  # arrays with a row for each step, by the names of ALIASES

CHUNK = 1 << 14  # rows read at a time
ALIASES = {  # what others call the columns
    "observation": ("observation", "observations"),
    "action": ("action", "actions"),
    "reward": ("reward", "rewards"),
    "terminated": ("terminated", "terminations", "terminals"),
    "truncated": ("truncated", "truncations", "timeouts"),
    "next_observation": ("next_observation", "next_observations"),
    "episode": ("episode",),
    "step": ("step",),
}
BOUNDARIES = ("terminated", "truncated", "episode", "step")  # any of these tells episodes apart


@dataclass(frozen=True)
class PerEpisode:
    """What is known once for each episode; None where it isn't."""

    final_observation: Array | None = None  # (episodes, ...)
    terminated: Array | None = None  # (episodes,)
    seed: Array | None = None  # (episodes,)

    @classmethod
    def of(cls, name: str, given: Mapping[str, Array]) -> "PerEpisode":
        """Check the arrays of a source.

        Raises:
            InputError: one holds what can't be imported.
        """
        check_kinds(name, {n: (values.dtype, values.shape[1:]) for n, values in given.items()})
        return cls(**{n: narrow(n, values) for n, values in given.items()})

    def known(self) -> dict[str, Array]:
        """The arrays that there are."""
        return {name: values for name, values in vars(self).items() if values is not None}


def own_names(name: str, names: Iterable[str]) -> dict[str, str]:
    """Which of a source's names stand for which column.

    Args:
        name: of the source.
        names: that it has.

    Raises:
        InputError: two names for one column.
    """
    own: dict[str, str] = {}
    names = set(names)
    for column, aliases in ALIASES.items():
        present = [alias for alias in aliases if alias in names]
        if len(present) > 1:
            raise InputError(f"{name} has {' and '.join(present)}: keep one of them")
        if present:
            own[column] = present[0]
    return own


def check_columns(name: str, columns: Iterable[str]) -> None:
    """Make sure that there is what every data set needs.

    Raises:
        InputError: a column is missing, or nothing tells where an episode ends.
    """
    columns = set(columns)
    for needed in ("observation", "action", "reward"):
        if needed not in columns:
            raise InputError(
                f"{name} has no {needed}s: it must have observations, actions and rewards"
            )
    if not columns & set(BOUNDARIES):
        raise InputError(
            f"{name} doesn't tell where an episode ends: give it terminations and truncations, or "
            "the number of the episode in each row"
        )


@dataclass
class _Splitter:
    """Episodes from chunks of rows."""

    name: str
    once: PerEpisode
    count: int = 0
    numbers: set[int] = field(default_factory=set)  # of the episodes so far, if they have numbers

    def episode(self, rows: Rows) -> Incoming | None:
        number, count = self._number(rows), self.count
        self.count += 1
        where = f"{self.name}: episode {number}"
        _check_steps(where, rows)
        for name, values in self.once.known().items():
            if count >= len(values):
                raise InputError(
                    f"{self.name} has a {name} for {len(values):,} episodes, and more episodes"
                )
        once = {name: values[count] for name, values in self.once.known().items()}
        following = _following(where, rows)
        by_row = bool(rows["terminated"][-1]) if "terminated" in rows else False
        return incoming(
            where,
            rows["observation"],
            rows["action"],
            rows["reward"],
            once.get("final_observation", following),
            bool(once.get("terminated", by_row)),
            int(once.get("seed", UNKNOWN_SEED)),
        )

    def _number(self, rows: Rows) -> int:
        if "episode" not in rows:
            return self.count
        number = int(rows["episode"][0])
        if number in self.numbers:
            raise InputError(
                f"{self.name}: episode {number} goes on after its end, or comes in two parts: the "
                "rows of an episode must stand together, and only its last one be an end"
            )
        self.numbers.add(number)
        return number


def split(name: str, chunks: Iterable[Rows], once: PerEpisode) -> Iterator[Incoming]:
    """Divide rows into episodes, in bounded memory.

    An episode ends where it is terminated or truncated, before another episode's number or a
    step 0, and at the end of the rows.

    Args:
        name: of the source.
        chunks: of rows, in order.
        once: what is known once for each episode.

    Raises:
        InputError: gaps in an episode, one that is too long or in two parts, as many episodes as
            `once` doesn't have, or as `incoming`.
    """
    splitter, rest = _Splitter(name, once), None
    for given in chunks:
        chunk = {n: narrow(n, values) for n, values in given.items()}
        rest = chunk if rest is None else {n: np.concatenate((rest[n], chunk[n])) for n in rest}
        begin = 0
        for end in _ends(name, rest):
            yield from _some(splitter.episode({n: v[begin:end] for n, v in rest.items()}))
            begin = end
        rest = {n: v[begin:] for n, v in rest.items()}
        if len(rest["reward"]) > MAX_EPISODE_STEPS:
            raise InputError(
                f"{name}: episode {splitter.count} has more than {MAX_EPISODE_STEPS:,} steps: "
                "does something tell where it ends?"
            )
    if rest is not None and len(rest["reward"]):
        yield from _some(splitter.episode(rest))
    for column, values in once.known().items():
        if len(values) != splitter.count:
            raise InputError(
                f"{name} has a {column} for {len(values):,} episodes, but {splitter.count:,} "
                "episodes: they must be as many"
            )


def narrow(name: str, values: Array) -> Array:
    """A column without the axis of width 1 that some give to what is one number a row."""
    return values if name in WIDE else values.reshape(len(values))


def _some(episode: Incoming | None) -> list[Incoming]:
    return [] if episode is None else [episode]


def _ends(name: str, rows: Rows) -> list[int]:
    """Where episodes end: after which rows, but the last one unless it says so itself."""
    is_end = np.zeros(len(rows["reward"]), dtype=bool)
    for flag in ("terminated", "truncated"):
        if flag in rows:
            is_end |= flags(name, flag, rows[flag])
    if "episode" in rows:
        is_end[:-1] |= rows["episode"][1:] != rows["episode"][:-1]
    elif "step" in rows:
        is_end[:-1] |= rows["step"][1:] == 0
    return [int(row) + 1 for row in np.flatnonzero(is_end)]


def _check_steps(where: str, rows: Rows) -> None:
    """The steps of an episode are numbered without a gap, from 0."""
    if "step" not in rows:
        return
    expected = np.arange(len(rows["step"]))
    wrong = np.flatnonzero(rows["step"] != expected)
    if len(wrong):
        first = wrong[0]
        raise InputError(
            f"{where} has step {rows['step'][first]} where step {first} was expected: its steps "
            "must be numbered from 0 without a gap"
        )


def _following(where: str, rows: Rows) -> Array | None:
    """The observation after the last action, if that is known.

    Raises:
        InputError: an observation after an action isn't the one before the next.
    """
    if "next_observation" not in rows:
        return None
    after, before = rows["next_observation"][:-1], rows["observation"][1:]
    apart = after.astype(np.float32) != before.astype(np.float32)
    if apart.any():
        step = np.argwhere(apart)[0, 0]
        raise InputError(
            f"{where} has a gap after step {step}: the observation after that step isn't the one "
            "before the next"
        )
    last: Array = rows["next_observation"][-1]
    return last
