"""Rows with times: where episodes end, and rows on an even clock."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.coordinates import wrapped
from jbrep.dataset.formats.episodes import ENDS, Rows, flags
from jbrep.dataset.layout import Layout
from jbrep.errors import InputError

Array = NDArray[Any]

MOST_RAW = 20_000_000  # rows of what is cut, or brought to another clock
_SLACK = 1e-6  # of a step, by which rounding may shift a time
_LATE = 0.1  # of a step, by which a reading of an even clock may be late and count as on time
_PAUSE = 10  # usual steps
_EVEN = 0.1  # by which most steps of an even clock may differ from the median
_SIGNALS = ("observation", "action", "reward")


class Clock:
    """Divides rows with times, and brings them to an even clock.

    Args:
        layout: which says how.
        angles: which numbers of an observation jump by a full turn, (d,).
        counts: of what was done, for the report.
    """

    def __init__(self, layout: Layout, angles: NDArray[np.bool_], counts: Counter[str]):
        self._layout, self._angles, self._counts = layout, angles, counts

    def cut(self, name: str, chunks: Iterator[Rows]) -> Iterator[Rows]:
        """Number the episodes: a new one where time goes back or is silent for too long.

        And where the table says so itself.
        """
        number, before, known = 0, dict[str, Array](), set[int]()
        usual: float | None = None  # step, by the first rows
        for rows in chunks:
            if not len(rows["time"]):
                continue
            last = before or {key: values[:1] for key, values in rows.items()}
            begins = np.zeros(len(rows["time"]), bool)
            if "episode" in rows:
                begins |= np.diff(rows["episode"], prepend=last["episode"]) != 0
                labels = [*([] if before else rows["episode"][:1]), *rows["episode"][begins]]
                if known & {*labels} or len({*labels}) < len(labels):
                    raise InputError(
                        f"{name}: an episode comes in two parts: its rows must stand together"
                    )
                known |= {*labels}
            for flag in (flag for flag in ENDS if flag in rows):
                ended = np.concatenate((before[flag] if before else [False], rows[flag][:-1]))
                begins |= flags(name, flag, ended)
            step = np.diff(rows["time"], prepend=last["time"])
            back, silent = step < 0, step > (self._layout.gap or np.inf)
            if not (self._layout.gap or self._layout.rate):
                usual = usual or _usual(step)
                pauses = step >= _PAUSE * (usual or np.inf)
                self._counts["pauses"] += int((pauses & ~begins).sum())
            self._counts["back"] += int((back & ~begins).sum())
            self._counts["gaps"] += int((silent & ~begins).sum())
            numbers = number + np.cumsum(begins | back | silent)
            yield {**rows, "episode": numbers}
            number, before = int(numbers[-1]), {key: v[-1:] for key, v in rows.items()}

    def parts(self, rows: Rows) -> Iterator[Rows]:
        """The rows of an episode, each at its time, in parts that are whole and not too long."""
        parts = self._resampled(rows) if self._layout.rate else iter([self._once_each(rows)])
        for part in parts:
            steps = len(part["action"])
            length = self._layout.length or steps
            self._counts["cuts"] += max(0, steps - 1) // max(length, 1)
            for begin in range(0, steps, length or 1):
                self._counts["last"] += min(length, steps - begin)
                some = {name: values[begin : begin + length] for name, values in part.items()}
                yield some | ({"step": some["step"] - begin} if "step" in some else {})

    def _once_each(self, rows: Rows) -> Rows:
        """The rows without those that have the time of the one before; how it ends is kept."""
        if "time" not in rows:
            return rows
        again = np.diff(rows["time"], prepend=-np.inf) == 0
        self._counts["repeated"] += int(again.sum())
        once = {name: values[~again] for name, values in rows.items()}
        for name in (name for name in (*ENDS, "next_observation") if name in rows):
            once[name] = once[name].copy()
            once[name][-1] = rows[name][-1]
        return once

    def _resampled(self, rows: Rows) -> Iterator[Rows]:
        """The rows on an even clock, from where each column has had a reading.

        Where it is known what was observed after the last action, the last step leads there.
        """
        time, rate, size = rows["time"], self._layout.rate or 1.0, rows["observation"].shape[1]
        values = np.column_stack([rows[name] for name in _SIGNALS if name in rows])
        known = np.isfinite(values).T
        begin = max(time[some.argmax()] if some.any() else np.inf for some in known)
        if not np.isfinite(begin):
            self._counts["never"] += len(time)
            return
        final = _final(rows)
        if final is not None:  # a reading, a usual step later
            unknown = np.full(values.shape[1] - size, np.nan)
            values = np.vstack((values, np.append(final, unknown)))
            time = np.append(time, time[-1] + (_usual(np.diff(time)) or 1 / rate))
        length = (time[-1] - begin) * rate
        count = int(length + _SLACK) + 1 if final is None else math.ceil(length - _LATE)
        if count > MOST_RAW:
            raise InputError(f"an episode has {count:,} steps at {rate:g} Hz: give a lower --rate")
        even = self._even(begin + np.arange(count) / rate, time, values)
        whole = np.isfinite(even).all(axis=1)
        self._counts["resampled"] += count
        self._counts["stale"] += int((~whole).sum())
        edges = np.flatnonzero(np.diff(np.concatenate(([False], whole, [False]))))
        for first, end in edges.reshape(-1, 2).tolist():
            some = even[first:end]
            part = {"observation": some[:, :size], "action": some[:, size:]}
            if "reward" in rows:
                part |= {"action": some[:, size:-1], "reward": some[:, -1]}
            if final is not None and end == count:
                is_last = np.arange(first, end) == end - 1
                part |= {name: is_last & bool(rows[name][-1]) for name in ENDS if name in rows}
                part["next_observation"] = np.vstack((part["observation"][1:], final))
            yield part

    def _even(self, grid: Array, time: Array, values: Array) -> Array:
        """Columns on the clock, (n, c), of their readings at other times; NaN where they have none.

        Those of observations come first.
        """
        size, linear = len(self._angles), self._layout.fill == "linear"
        columns = list[Array]()
        for i, column in enumerate(values.T):
            some = np.isfinite(column)
            turning = i < size and bool(self._angles[i])
            columns.append(
                self._signal(grid, time[some], column[some], linear and i < size, turning)
            )
        return np.stack(columns, axis=1)

    def _signal(
        self, grid: Array, time: Array, values: Array, linear: bool, turning: bool
    ) -> Array:
        """A column on the clock; NaN where its readings are too far away."""
        step = 1 / (self._layout.rate or 1.0)
        own = None if linear else timestep_of(time)
        slack = _SLACK * step
        late = max(slack, _LATE * min(step, own)) if own else slack
        last = np.searchsorted(time, grid + late, side="right") - 1
        age = grid - time[last]
        if linear:
            following = time[np.minimum(last + 1, len(time) - 1)]
            age = np.where(age > slack, np.maximum(age, following - time[last]), age)
            even = np.interp(grid, time, np.unwrap(values) if turning else values)
            even = wrapped(even) if turning else even
        else:
            even = values[last].astype(float)
        even[age > (self._layout.gap or np.inf) + slack] = np.nan
        return even


def _final(rows: Rows) -> Array | None:
    """What was observed after the last action of an episode, (d,), if all of it is known."""
    if "next_observation" not in rows or not np.isfinite(rows["next_observation"][-1]).all():
        return None
    last: Array = rows["next_observation"][-1]
    return last


def _usual(steps: Array) -> float | None:
    """The median of the steps on, if there are any."""
    forward = steps[steps > 0]
    return float(np.median(forward)) if len(forward) else None


def timestep_of(time: Array) -> float | None:
    """From row to row [s], if the clock is even."""
    steps = np.diff(time)
    steps = steps[steps > 0]
    if not len(steps):
        return None
    low, median, high = np.percentile(steps, (5, 50, 95))
    even = (1 - _EVEN) * median <= low and high <= (1 + _EVEN) * median
    usual = steps[np.abs(steps - median) <= _EVEN * median]
    return _rounded(float(usual.mean())) if even and len(usual) else None


def _rounded(step: float) -> float:
    """A step [s] to 4 digits, or the one of a whole number a second that has the same 4 digits.

    Digits that end before the fourth say the step themselves: 0.007 isn't 1/143.
    """
    short = float(f"{step:.4g}")
    rate = round(1 / short) if short > 1e-9 else 0
    is_short = short == float(f"{step:.3g}")
    return 1 / rate if rate and not is_short and float(f"{1 / rate:.4g}") == short else short
