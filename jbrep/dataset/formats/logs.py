"""Tables as sources of episodes: rows read by their layout, cut, and brought to a clock."""

import math
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from jbrep.coordinates import wrapped
from jbrep.dataset.formats.clock import MOST_RAW, Clock, timestep_of
from jbrep.dataset.formats.episodes import WIDE, Incoming, Rows, Source, check_whole
from jbrep.dataset.formats.flat import split
from jbrep.dataset.formats.tables import (
    DEGREES,
    SECONDS,
    Leaf,
    Roles,
    Table,
    features_of_table,
    is_of_task,
    roles_of,
    sort_of,
    width,
)
from jbrep.dataset.layout import Layout
from jbrep.envs.task import MAX_EPISODE_STEPS
from jbrep.errors import InputError, listed
from jbrep.text import counted

Array = NDArray[Any]

_SAID = {  # of what is counted: what it is, and what became of it
    "rows": ("row", "read"),
    "repeated": ("row", "at the time of the row before: left out"),
    "back": ("step", "back in time: an episode ends there"),
    "gaps": ("gap", "of more than {gap} s: an episode ends there"),
    "never": ("row", "of episodes in which a column has no reading: left out"),
    "pauses": (
        "pause",
        "ten times as long as the usual step or longer, within an episode: --gap ends it there",
    ),
    "resampled": ("row", "at {rate:g} Hz, {fill}"),
    "stale": ("row", "of these without a reading of each column within {gap} s: left out"),
    "cuts": ("cut", "after {length} rows"),
    "last": ("row", "after the last action of an episode, or alone: no step begins there"),
}


def source_of_table(table: Table, given: Layout | None = None, missing: str = "") -> Source:
    """A table as a source of episodes.

    Args:
        table: to read.
        given: what the user says of its columns, before what its format says.
        missing: what becomes of numbers that are missing, see `without_missing`.
    """
    layout = _both(table, given or Layout())
    roles = roles_of(table, layout)
    seen, is_own = roles["observation"], is_of_task(table, roles)
    reader = _Reader(table, layout, roles, missing)
    return Source(
        table.name,
        table.label,
        reader.episodes,
        task=table.task if is_own else None,
        features=() if is_own else tuple(features_of_table(table, seen)),
        why_no_task="its columns aren't those of its task" if table.task else Source.why_no_task,
        rows=None if layout.rate else table.rows,
        has_rewards="reward" in roles,
        subtracted=reader.factors * [each.subtracted for each in seen],
        timestep=1 / layout.rate if layout.rate else table.timestep or reader.timestep,
        notes=reader.notes(),
        changes=reader.changes,
    )


def _both(table: Table, given: Layout) -> Layout:
    """What the user says, and what the format says where the user says nothing."""
    usual = Layout()
    said = {name: getattr(given, name) for name in Layout.__struct_fields__}
    layout = table.layout.replace(**{n: v for n, v in said.items() if v != getattr(usual, n)})
    for name in ("gap", "rate"):
        if getattr(layout, name) and not layout.time:
            raise InputError(f"--{name} needs --time, the column of times")
    if layout.fill != usual.fill and not layout.rate:
        raise InputError(f"--fill {layout.fill} needs --rate: else nothing stands between readings")
    if table.is_sparse and not (layout.observations and layout.actions and layout.rate):
        names = [name for name in table.schema.names if name != layout.time]
        raise InputError(
            f"{table.name} has topics with clocks of their own: give --rate, --observations and "
            f"--actions, of {', '.join(names)}"
        )
    return layout


class _Reader:
    """Reads a table's rows as episodes, and counts what it does to them."""

    def __init__(self, table: Table, layout: Layout, roles: Roles, missing: str):
        self._table, self._layout, self._roles = table, layout, roles
        self._counts = Counter[str]()
        self._may_miss = bool(missing or layout.rate)
        seen = roles["observation"]
        self._angles = np.array([each.is_angle for each in seen])
        turned = self._angles & np.array([each.unit in DEGREES for each in seen])
        self.factors = np.where(turned, math.pi / 180, 1)  # of what is observed, (d,)
        self._columns = list(dict.fromkeys(e.column for some in roles.values() for e in some))
        self.timestep = self._timestep() if "time" in roles else None

    def _timestep(self) -> float | None:
        """What an even clock has from row to row [s], by the first rows."""
        first = next(self._rows(), None)
        return None if first is None else timestep_of(first["time"])

    def episodes(self) -> Iterator[Incoming]:
        """The episodes, from the first on."""
        self._counts.clear()
        name, layout, chunks = self._table.name, self._layout, self._rows()
        clock = Clock(layout, self._angles, self._counts)
        if layout.time:
            chunks = clock.cut(name, chunks)
        most = MOST_RAW if layout.rate or layout.length else MAX_EPISODE_STEPS
        for episode in split(name, chunks, self._once(), most, clock.parts):
            self._counts["last"] -= len(episode.action)
            yield episode

    def _once(self) -> dict[str, Array]:
        """What is known once for each episode, of the columns that are observed."""
        once, task = {**self._table.once}, self._table.task
        if (final := once.pop("final_observation", None)) is not None and task:
            names, seen = task.feature_names, [each.name for each in self._roles["observation"]]
            if {*seen} <= {*names}:
                chosen = final[:, [names.index(name) for name in seen]]
                once["final_observation"] = self._turned(chosen)
        return once

    def _turned(self, seen: Array) -> Array:
        """Observations (n, d) with their angles in [-pi, pi) rad."""
        if not self._angles.any():
            return seen
        turned = seen * self.factors
        return np.where(self._angles, wrapped(turned), turned)

    def _rows(self) -> Iterator[Rows]:
        """The rows by role, some at a time."""
        first, origin, labels = 0, None, dict[Any, int]()
        for batch in self._table.batches(self._columns):
            self._check_late()
            arrays = {name: self._numbers(batch, name, first) for name in self._columns}
            rows = dict[str, Array]()
            for role, leaves in self._roles.items():
                each = [arrays[leaf.column] for leaf in leaves]
                each = [
                    values if leaf.place is None else values[:, leaf.place]
                    for leaf, values in zip(leaves, each, strict=True)
                ]
                for leaf, values in zip(leaves, each, strict=True):
                    self._check(leaf, role, values, first)
                    if role in WIDE:
                        self._check_whole(leaf, batch.column(leaf.column), first)
                rows[role] = np.stack(each, axis=1) if role in WIDE else each[0]
            if "time" in rows:
                time = rows["time"]
                time = time if time.dtype.kind == "f" else time.astype(np.int64)
                origin = time[:1] if origin is None or not len(origin) else origin
                passed = (time - origin).astype(float)
                rows["time"] = passed * self._seconds(self._roles["time"][0])
            if "episode" in rows and rows["episode"].dtype.kind not in "iu":
                numbers = [labels.setdefault(e, len(labels)) for e in rows["episode"].tolist()]
                rows["episode"] = np.array(numbers, int)
            for role in {"observation", "next_observation"} & rows.keys():
                rows[role] = self._turned(rows[role])
            first += batch.num_rows
            self._counts["rows"] += batch.num_rows
            yield rows

    def _check_late(self) -> None:
        """Refuse what came up too late, if it was asked for."""
        asked = (*self._layout.observations, *self._layout.actions)
        for name, problem in self._table.late.items():
            if any(fnmatchcase(name, pattern) for pattern in asked):
                raise InputError(problem)

    def _check(self, leaf: Leaf, role: str, values: Array, first: int) -> None:
        """Refuse a number that is missing where none may be."""
        if values.dtype.kind != "f" or (self._may_miss and role in (*WIDE, "reward")):
            return
        if len(wrong := np.flatnonzero(~np.isfinite(values))):
            told = f"{self._at(first + int(wrong[0]))}: {leaf.name!r} is empty, or no finite number"
            can_miss = role in (*WIDE, "reward")
            how = "leave the row out, or give --missing" if can_miss else "or leave the row out"
            raise InputError(f"{told}: correct it, {how}")

    def _check_whole(self, leaf: Leaf, column: pa.Array, first: int) -> None:
        """Refuse whole numbers that floats lose digits of, as those beside empty cells become."""
        values = column if leaf.place is None else pc.list_element(column, leaf.place)
        if pa.types.is_integer(values.type):
            whole = values.fill_null(0).to_numpy(zero_copy_only=False)
            check_whole(whole, lambda row: f"{self._at(first + row)}: {leaf.name!r}")

    def _seconds(self, leaf: Leaf) -> float:
        """What brings the times to seconds."""
        kind = self._table.schema.field(leaf.column).type
        unit = "ns" if pa.types.is_temporal(kind) else leaf.unit or "s"
        if unit not in SECONDS:
            raise InputError(
                f"{self._table.name}: the times {leaf.name!r} are in {unit!r}: choose one of "
                f"{', '.join(SECONDS)}"
            )
        return SECONDS[unit]

    def _at(self, row: int) -> str:
        return f"{self._table.name}, {self._table.place(row)}"

    def _numbers(self, batch: pa.RecordBatch, name: str, first: int) -> Array:
        """A column as an array: numbers, of which empty ones are NaN; or words."""
        column, known = batch.column(name), self._table.schema.field(name).type
        kind, empty, size = column.type, column.null_count, width(known)
        if sort_of(kind) != sort_of(known):
            raise InputError(f"{self._at(first)}: {name!r} has {kind}, not {known} as before")
        may_miss = self._may_miss and sort_of(known) != "word"
        if empty and (size or not (pa.types.is_floating(kind) or may_miss)):
            row = int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0])
            raise InputError(f"{self._at(first + row)}: {name!r} has an empty cell: fill it")
        if size is not None:
            lengths = column.value_lengths().to_numpy(zero_copy_only=False)
            if len(wrong := np.flatnonzero(lengths != size)):
                row = int(wrong[0])
                raise InputError(
                    f"{self._at(first + row)}: {name!r} has {lengths[row]} numbers, not {size} as "
                    "before"
                )
            flat = column.flatten()
            flat = flat.cast(pa.float64()) if pa.types.is_decimal(flat.type) else flat
            numbers: Array = flat.to_numpy(zero_copy_only=False)
            return numbers.reshape(len(column), size)
        if pa.types.is_temporal(kind):
            wide = pa.timestamp("ns") if pa.types.is_timestamp(kind) else pa.duration("ns")
            try:
                column = column.cast(wide).cast(pa.int64())
            except pa.ArrowInvalid:
                raise InputError(
                    f"{self._at(first)}: {name!r} has a time beyond the years 1678 to 2262"
                ) from None
        elif pa.types.is_dictionary(kind):
            column = column.dictionary_decode()
        elif pa.types.is_decimal(kind) or (empty and pa.types.is_boolean(kind)):
            column = column.cast(pa.float64())
        return np.asarray(column.to_numpy(zero_copy_only=False))

    def changes(self) -> dict[tuple[str, str], int]:
        """What was done to the rows that were read last, how often."""
        layout, counts = self._layout, self._counts
        how = {name: getattr(layout, name) for name in ("gap", "rate", "length")}
        how["fill"] = (
            "interpolated" if layout.fill == "linear" else f"by the {layout.fill} readings"
        )
        told = [(*words, counts[what]) for what, words in _SAID.items() if counts[what]]
        return {(noun, said.format(**how)): count for noun, said, count in told}

    def notes(self) -> tuple[str, ...]:
        """What is done to the columns."""
        notes = list(self._table.notes)
        if unused := [name for name in self._table.schema.names if name not in self._columns]:
            notes.append(f"not used: {listed(unused)}")
        if self._layout.time and not self._layout.rate and self.timestep is None:
            notes.append("the clock is uneven: --rate brings the rows to an even one")
        if self._angles.any():
            degrees = int((self.factors != 1).sum())
            angles = counted(int(self._angles.sum()), "angle")
            notes.append(f"{angles} brought to [-pi, pi) rad, {degrees} of them from degrees")
        return tuple(notes)
