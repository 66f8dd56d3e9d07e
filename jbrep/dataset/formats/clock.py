"""Rows with times: parts of an episode on an even clock, or with a row for each time."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.columns import Array
from jbrep.dataset.formats.episodes import MOST_RAW, Counts, Rows, stretches, usual_step
from jbrep.dataset.formats.frame import ENDS
from jbrep.dataset.formats.roles import Leaf
from jbrep.dataset.layout import Layout
from jbrep.errors import InputError, listed

_SLACK = 1e-6  # of a step, by which rounding may shift a time
_LATE = 0.1  # of a step, by which a reading of an even clock may be late and count as on time
_ALIKE = 0.01  # by which even clocks may differ and count as the same
_MOST_GROWTH = 1000  # rows made of each that was read, unless they are few
_MOST_SHORT = 1_000_000  # rows that count as few
_MOST_NUMBERS = 50_000_000  # in all columns together
_MOST_PASSED = 0.2  # share of readings that are skipped without a note
_AS_FAST = 1.1  # readings a row, up to which that is noted
_EVEN = 0.1  # by which most steps of an even clock may differ from the median


def in_parts(rows: Rows, layout: Layout, leaves: Sequence[Leaf], counts: Counts) -> Iterator[Rows]:
    """The rows of an episode in parts that are whole and not too long, each row at its time.

    Leaves are those of observation, action and reward, in this order.
    """
    resamples = layout.rate is not None
    for part in _resampled(rows, layout, leaves, counts) if resamples else _once_each(rows, counts):
        steps = len(part["action"])
        length = layout.length or steps
        counts["cut", f"after {length} rows"] += (steps - 1) // length
        for begin in range(0, steps, length):
            some = {name: values[begin : begin + length] for name, values in part.items()}
            yield some | ({"step": some["step"] - begin} if "step" in some else {})


def _once_each(rows: Rows, counts: Counts) -> Iterator[Rows]:
    """The rows without those that have the time of the one before; how it ends is kept."""
    again = np.diff(rows.get("time", np.arange(len(rows["action"]))), prepend=-np.inf) == 0
    counts["row", "at the time of the row before: left out"] += int(again.sum())
    is_last, after = np.append(~again[1:], True), {*ENDS, "next_observation"}
    yield {name: values[is_last if name in after else ~again] for name, values in rows.items()}


def _resampled(
    rows: Rows, layout: Layout, leaves: Sequence[Leaf], counts: Counts
) -> Iterator[Rows]:
    """The rows on an even clock, from where each column has had a reading.

    Where it is known what was observed after the last action, the last step leads there.
    """
    time, rate, size = rows["time"], layout.rate or 1.0, rows["observation"].shape[1]
    signals = [rows[name] for name in ("observation", "action", "reward") if name in rows]
    values = np.column_stack(signals)
    known = np.isfinite(values)
    if not (has_some := known.any(axis=0)).all():
        silent = listed([leaves[i].name for i in np.flatnonzero(~has_some).tolist()])
        counts["row", f"of episodes without a reading of {silent}: left out"] += len(time)
        return
    begin = time[known.argmax(axis=0)].max()
    final: Any = rows.get("next_observation", [np.nan])[-1]
    has_final = bool(np.isfinite(final).all())
    if has_final:  # a reading, a usual step later
        unknown = np.full(values.shape[1] - size, np.nan)
        values = np.vstack((values, np.append(final, unknown)))
        time = np.append(time, time[-1] + (usual_step(np.diff(time)) or 1 / rate))
    with np.errstate(over="ignore"):
        length = (time[-1] - begin) * rate
    most = max(_MOST_GROWTH * len(time), _MOST_SHORT)
    if not length <= min(most, _MOST_NUMBERS / values.shape[1], MOST_RAW):
        raise InputError(
            f"an episode of {len(time):,} rows lasts {time[-1] - begin:.6g} s, {length:,.6g} rows "
            f"at {rate:g} Hz: correct its times, end it at pauses by `gap`, or give a lower `rate`"
        )
    count = math.ceil(length - _LATE) if has_final else int(length + _SLACK) + 1
    grid = begin + np.arange(count) / rate
    is_linear = layout.fill == "linear"
    columns, old = zip(
        *(
            _signal(grid, time, column, layout, is_linear and i < size, leaves[i], counts)
            for i, column in enumerate(values.T)
        ),
        strict=True,
    )
    even = np.stack(columns, axis=1)
    whole = np.isfinite(even).all(axis=1)
    how = "interpolated" if is_linear else "by the latest readings"
    counts["row", f"at {rate:g} Hz, {how}"] += count
    silent = f"dropped, as a column was silent for more than {layout.gap} s"
    counts["row", silent] += int((~whole).sum())
    held = "kept with a reading older than two of its usual intervals"
    counts["row", held] += int((whole & np.any(old, axis=0)).sum())
    for first, end in stretches(whole):
        some = even[first:end]
        part = {"observation": some[:, :size], "action": some[:, size:]}
        if "reward" in rows:
            part |= {"action": some[:, size:-1], "reward": some[:, -1]}
        if has_final and end == count:
            is_last = np.arange(first, end) == end - 1
            part |= {name: is_last & bool(rows[name][-1]) for name in ENDS if name in rows}
            part["next_observation"] = np.vstack((part["observation"][1:], final))
        yield part


def _signal(
    grid: Array,
    time: Array,
    values: Array,
    layout: Layout,
    is_linear: bool,
    leaf: Leaf,
    counts: Counts,
) -> tuple[Array, NDArray[np.bool_]]:
    """A column on the clock, NaN where no reading is near enough, and whether one is old."""
    some, step = np.isfinite(values), 1 / (layout.rate or 1.0)
    time, values, slack = time[some], values[some], _SLACK * step
    own = None if is_linear else timestep_of(np.diff(time))
    late = max(slack, _LATE * min(step, own)) if own else slack
    last = np.searchsorted(time, grid + late, side="right") - 1
    age = grid - time[last]
    if is_linear:
        following = time[np.minimum(last + 1, len(time) - 1)]
        age = np.where(age > slack, np.maximum(age, following - time[last]), age)
        low = leaf.turns_at
        even = np.interp(grid, time, values if low is None else np.unwrap(values))
        even = even if low is None else low + (even - low) % (2 * np.pi)
    else:
        even = values[last].astype(float)
        passed = len(time) - len(np.unique(last))
        if len(time) <= _AS_FAST * len(grid) and passed > _MOST_PASSED * len(time):
            bursts = (
                f"of {leaf.name} in bursts shorter than a step, but for the last of each: left out"
            )
            counts["reading", f"{bursts}; a higher --rate keeps more"] += passed
    even[age > (layout.gap or np.inf) + slack] = np.nan
    usual = max(step, usual_step(np.diff(time)) or 0.0)
    return even, age > 2 * usual + slack


def same_clock(one: float | None, other: float | None) -> bool:
    """Whether two steps [s] are of the same even clock; unknown ones may be."""
    return not (one and other) or math.isclose(one, other, rel_tol=_ALIKE)


def timestep_of(steps: Array) -> float | None:
    """The step of a clock [s] by those from row to row, if it is even."""
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
