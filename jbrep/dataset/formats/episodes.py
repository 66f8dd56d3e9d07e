"""Episodes: rows are cut into them, each is checked, and what is missing in it cut or held."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.columns import Array
from jbrep.dataset.formats.frame import ENDS
from jbrep.dataset.layout import Layout
from jbrep.dataset.schema import UNKNOWN_SEED, joined
from jbrep.envs.task import MAX_EPISODE_STEPS, most_held
from jbrep.errors import InputError

Rows = Mapping[str, Array]  # a row for each step, by the keys of ALIASES, and time
Counts = Counter[tuple[str, str]]  # of what was done: what it was done to, and what

MOST_RAW = 20_000_000  # rows of what is cut, or brought to another clock
_PAUSE = 10  # usual steps
_STAYS = "an episode of its own each; if the flag only stays true, keep its first row"
_PAUSES = "ten times as long as the usual step or longer, within an episode: `gap` ends it there"


class Incoming(NamedTuple):
    """An episode of n steps; numbers may be missing."""

    where: str  # it is, for messages
    observation: NDArray[np.float64]  # (n, d), before each action
    action: NDArray[np.float64]  # (n, k)
    reward: NDArray[np.float64]  # (n,), 0 where none is known
    final: NDArray[np.float64]  # (d,), after the last action
    terminated: bool
    truncated: bool  # maybe beside `terminated`; without that, always
    seed: int
    missing: int = 0  # numbers in whose place are others, or at which it was divided


def cut(
    name: str, chunks: Iterable[Rows], layout: Layout, counts: Counts
) -> Iterator[tuple[str, Rows]]:
    """What each episode is called, and its rows, in bounded memory.

    An episode ends where it is terminated or truncated, before another number of an episode or,
    without these, a step 0; where time goes back, or nothing comes for too long; and at the end.
    """
    begun, known, number, usual = list[Rows](), set[int](), None, None
    most = MOST_RAW if layout.rate or layout.length else MAX_EPISODE_STEPS

    def whole(*parts: Rows) -> tuple[str, Rows]:
        nonlocal number
        rows, last = joined(parts), number
        number = int(rows["episode"][0]) if "episode" in rows else len(known)
        if number in known and not (layout.time and number == last):
            raise InputError(
                f"{name}: episode {number} goes on after its end, or comes in two parts: the "
                "rows of an episode must stand together, and only its last one be marked an end"
            )
        known.add(number)
        return f"{name}: episode {number}", rows

    for rows in chunks:
        if layout.time and not (layout.gap or layout.rate):
            usual = usual or usual_step(np.diff(rows["time"]))  # by the first rows
        begins = _begins(name, begun[-1] if begun else None, rows, layout.gap, usual, counts)
        begin = 0
        for end in np.flatnonzero(begins).tolist():
            if begun or end:
                yield whole(*begun, _some(rows, begin, end))
            begun, begin = [], end
        begun.append(_some(rows, begin, None))
        if sum(len(each["action"]) for each in begun) > most:
            raise InputError(f"{name} has an episode of over {most:,} steps: where does it end?")
    if begun:
        yield whole(*begun)


def _some(rows: Rows, begin: int, end: int | None) -> Rows:
    return {name: values[begin:end] for name, values in rows.items()}


def _begins(
    name: str,
    before: Rows | None,
    rows: Rows,
    gap: float | None,
    usual: float | None,
    counts: Counts,
) -> NDArray[np.bool_]:
    begins, last = np.zeros(len(rows["action"]), bool), before or _some(rows, 0, 1)
    for flag in (name for name in ENDS if name in rows):
        if not np.isin(rows[flag], (0, 1)).all():
            raise InputError(f"{name} has a {flag} that is neither true nor false, 0 nor 1")
        ended = last[flag][-1:] if before else [False]
        after = np.concatenate((ended, rows[flag][:-1])).astype(bool)
        counts["row", f"{flag} right after one that was: {_STAYS}"] += int(
            (after & rows[flag].astype(bool)).sum()
        )
        begins |= after
    if "episode" in rows:
        begins |= np.diff(rows["episode"], prepend=last["episode"][-1:]) != 0
    elif "step" in rows:
        begins |= rows["step"] == 0
    if "time" in rows:
        step = np.diff(rows["time"], prepend=last["time"][-1:])
        back, silent, pause = step < 0, step > (gap or np.inf), step >= _PAUSE * (usual or np.inf)
        counts["step", "back in time: an episode ends there"] += int((back & ~begins).sum())
        counts["gap", f"of more than {gap} s: an episode ends there"] += int(
            (silent & ~begins).sum()
        )
        counts["pause", _PAUSES] += int((pause & ~begins).sum())
        begins |= back | silent
    return begins


def usual_step(steps: Array) -> float | None:
    """The median of the steps on, if there are any."""
    forward = steps[steps > 0]
    return float(np.median(forward)) if len(forward) else None


def stretches(mask: NDArray[np.bool_]) -> list[list[int]]:
    """Begin and end of each stretch of rows that are true."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    pairs: list[list[int]] = edges.reshape(-1, 2).tolist()
    return pairs


def episode_of(where: str, rows: Rows, once: Mapping[str, Any]) -> Incoming | None:
    """An episode, its parts checked; None if no step is left.

    Without the observation after its last action, the last step is left out, so that the
    observation before that becomes the final one: nothing is made up. What ended the episode came
    after it, so the episode counts as truncated then. Its final observation, how it ended and its
    seed may be known once.
    """
    observation, numbers = rows["observation"], np.arange(len(rows["action"]))
    if len(wrong := np.flatnonzero(rows.get("step", numbers) != numbers)):
        raise InputError(
            f"{where} has step {rows['step'][wrong[0]]:g} where step {wrong[0]} was expected: its "
            "steps must be numbered from 0 without a gap"
        )
    following = None
    if "next_observation" in rows:
        following = (after := rows["next_observation"])[-1]
        _check_following(where, after[:-1].astype(np.float32), observation[1:].astype(np.float32))
    final = once.get("final_observation", following)
    ended = {name: rows[name][-1] for name in ENDS if name in rows} | {**once}
    for name in ENDS:
        if (ends := ended.get(name, False)) not in (0, 1):
            raise InputError(f"{where} has {ends} for {name}: it must be 0 or 1")
    seed, steps = int(once.get("seed", UNKNOWN_SEED)), len(observation) - (final is None)
    if not UNKNOWN_SEED <= seed < 1 << 63:
        raise InputError(f"{where} has the seed {seed}: it must be from 0 to 2**63 - 1, or -1")
    if not steps:
        return None
    return Incoming(
        where,
        observation[:steps],
        rows["action"][:steps],
        rows["reward"][:steps] if "reward" in rows else np.zeros(steps),
        observation[-1] if final is None else np.asarray(final, np.float64),
        terminated=bool(ended.get("terminated", False)) and final is not None,
        truncated=bool(ended.get("truncated", False)),
        seed=seed,
    )


def _check_following(where: str, after: Array, before: Array) -> None:
    """What was observed after each step is what was before the next, to 32 bits."""
    apart = (after != before) & ~(np.isnan(after) & np.isnan(before))
    if apart.any():
        raise InputError(
            f"{where} has a gap after step {np.argwhere(apart)[0, 0]}: the observation after that "
            "step isn't the one before the next"
        )


def single(where: str, what: str, values: NDArray[np.float64]) -> NDArray[np.float32]:
    """Numbers in single precision."""
    with np.errstate(over="ignore"):
        rounded = values.astype(np.float32)
    if len(wrong := np.argwhere(~np.isfinite(rounded))):
        raise InputError(
            f"{where} has a number in its {what} that isn't finite, or beyond 32 bits, at step "
            f"{wrong[0, 0]}: correct the data, leave the episode out, or give `missing`"
        )
    return rounded


def count_missing(episode: Incoming) -> int:
    """How many numbers of an episode aren't finite."""
    parts = (episode.observation, episode.action, episode.reward, episode.final)
    return sum(int((~np.isfinite(part)).sum()) for part in parts)


def without_missing(episode: Incoming, missing: str) -> Iterator[Incoming]:
    """An episode in which all numbers are finite, or the parts of it that are.

    Skip leaves out the steps that aren't whole, and divides the episode there; hold:3 has the last
    number instead, for at most 3 steps in a row.
    """
    count = count_missing(episode) if missing else 0
    episode = episode._replace(missing=count)
    if count and missing == "skip":
        yield from _whole_parts(episode)
    else:
        yield _held(episode, most_held(missing)) if count else episode


def _whole_parts(episode: Incoming) -> Iterator[Incoming]:
    """Those of consecutive steps from a whole observation to the next; the first has the count."""
    seen = np.concatenate((episode.observation, episode.final[None]))
    is_whole = np.asarray(np.isfinite(seen).all(axis=1))
    steps = is_whole[:-1] & is_whole[1:] & np.isfinite(episode.reward)
    steps &= np.isfinite(episode.action).all(axis=1)
    for i, (begin, end) in enumerate(stretches(steps)):
        is_last = end == len(steps)
        yield episode._replace(
            observation=seen[begin:end],
            action=episode.action[begin:end],
            reward=episode.reward[begin:end],
            final=seen[end],
            terminated=episode.terminated and is_last,
            truncated=episode.truncated and is_last,
            seed=episode.seed if begin == 0 else UNKNOWN_SEED,
            missing=episode.missing if i == 0 else 0,
        )


def _held(episode: Incoming, most: int) -> Incoming:
    """The episode with the last numbers in place of missing ones; an action has none."""
    if len(wrong := np.argwhere(~np.isfinite(episode.action))):
        raise InputError(
            f"{episode.where} lacks its action at step {wrong[0, 0]}, which can't be held: leave "
            "the episode out, or give `missing` skip"
        )
    seen = np.concatenate((episode.observation, episode.final[None]))
    reward = np.concatenate(([np.nan], episode.reward))  # with the observation after it
    rows = np.column_stack((seen, reward))
    number = np.arange(len(rows))[:, None]
    last = np.maximum.accumulate(np.where(np.isfinite(rows), number, -1))
    lacking = (last < 0) | (number - last > most)
    lacking[0, -1] = False
    for step, column in np.argwhere(lacking)[:1]:
        what = "the reward" if column == seen.shape[1] else f"feature {column}"
        is_first = last[step, column] < 0
        why = "with none before to hold" if is_first else f"beyond hold:{most} of the last one"
        raise InputError(
            f"{episode.where}: {what} is missing at step {step}, {why}: give `missing` skip, hold "
            "it for longer, or leave the episode out"
        )
    filled = np.take_along_axis(rows, last, axis=0)
    return episode._replace(
        observation=filled[:-1, :-1], final=filled[-1, :-1], reward=filled[1:, -1]
    )
