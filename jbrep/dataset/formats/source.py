"""A frame as a source of episodes: read by its layout, cut, and brought to a clock."""

import math
import shlex
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa

from jbrep.coordinates import wrapped
from jbrep.dataset.columns import Array
from jbrep.dataset.formats import roles
from jbrep.dataset.formats.clock import in_parts, same_clock, timestep_of
from jbrep.dataset.formats.episodes import Counts, Incoming, Rows, cut, episode_of
from jbrep.dataset.formats.frame import ENDS, Frame, width
from jbrep.dataset.formats.roles import DEGREES, MOST_RADIANS, RADIANS, WIDE, Leaf, Turns, second_of
from jbrep.dataset.layout import Layout
from jbrep.envs.task import Task
from jbrep.errors import InputError, first_line, listed, refusing
from jbrep.text import counted

_SIGNALS = ("observation", "action", "reward")
_EXACT = ("time", "episode")  # of which no digit may be lost
# in several sources:
_ALIKE = ("task", "features", "action_names", "has_rewards", "action_bounds", "subtracted")
LAST = ("row", "at the end of an episode, which has no next state: dropped")


class Source:
    """Reads the rows of a frame as episodes, and counts what it does to them.

    What the user says of its columns comes before what its format says.

    Attributes:
        name: for messages and provenance.
        task: that they are of; None if one is made from the data alone.
        features: of that one.
        action_names: likewise.
        action_bounds: lower and upper ones, (2, k); infinite where there are none.
        subtracted: offsets of features that observations lack already, (d,).
        timestep: from row to row [s], if that is known.
        rows: how many there are, if that is known.
        has_changed: whether its files have, since they were opened.
    """

    def __init__(self, frame: Frame, given: Layout | None = None, missing: str = ""):
        self.frame, self._layout = frame, _both(frame, given or Layout())
        self._roles, rate = roles.roles_of(frame, self._layout), self._layout.rate
        self._counts, self._others = Counts(), tuple[Source, ...]()
        self.has_changed: Callable[[], bool] = lambda: False
        self._may_miss = (*WIDE, "reward") if missing or rate else ()
        used = [(role, leaf.column) for role, some in self._roles.items() for leaf in some]
        self._columns = list(dict.fromkeys(column for _, column in used))
        self._numeric = {column for role, column in used if role not in _EXACT}
        seen, is_own = self._roles["observation"], roles.is_of_task(frame, self._roles)
        self._turns = Turns()
        self._angles = np.array([each.is_angle for each in seen])
        degrees = self._angles & np.array([each.unit in DEGREES for each in seen])
        self._factors = np.where(degrees, math.pi / 180, 1)  # of what is observed, (d,)
        self.name, self.rows = frame.name, None if rate else frame.rows
        self.task, self.has_rewards = frame.task if is_own else None, "reward" in self._roles
        other = "its columns aren't those of its task"
        self.why_no_task = other if frame.task else frame.why_no_task
        self.features = () if is_own else roles.features_of(frame.name, seen)
        self.action_names = roles.action_names_of(self._roles["action"])
        places = [leaf.place or 0 for leaf in self._roles["action"]]
        self.action_bounds = frame.action_bounds and np.array(frame.action_bounds)[:, places]
        self.subtracted = self._factors * [each.subtracted for each in seen]
        self._second = second_of(frame.name, self._roles["time"][0]) if self._layout.time else 1.0
        first = next(self._rows(), None) if self._layout.time else None
        self._clock = None if first is None else timestep_of(_steps(first, self._layout.gap))
        own = self._clock if given and given.time else None  # what the user names comes first
        self.timestep = 1 / rate if rate else own or frame.timestep or self._clock

    def join(self, *others: "Source") -> None:
        """Add the episodes of others, which must be alike."""
        for other in others:
            alike = {what: (getattr(self, what), getattr(other, what)) for what in _ALIKE}
            differ = [what for what, both in alike.items() if not np.array_equal(*both)]
            differ += [] if same_clock(self.timestep, other.timestep) else ["timestep"]
            if differ:
                what = differ[0].replace("_", " ")
                raise InputError(
                    f"{other.name} has another {what} than {self.name}: import it alone"
                )
        every, self._others = (self, *others), others
        self.name += f" and {counted(len(others), 'more')}" if others else ""
        self.timestep = self.timestep if all(each.timestep for each in every) else None
        self.rows = sum(each.rows or 0 for each in every) if all(e.rows for e in every) else None

    def interpolate_as(self, task: Task) -> None:
        """Take the angles of a task's features the shorter way round."""
        for source in (self, *self._others):
            known = zip(source._roles["observation"], task.features, strict=False)
            seen = [leaf._replace(feature=feature) for leaf, feature in known]
            source._roles = {**source._roles, "observation": seen}

    def changes(self) -> Counts:
        """What was done to the rows that were read last."""
        return sum((other.changes() for other in self._others), +self._counts)

    def episodes(self) -> Iterator[Incoming]:
        """The episodes, from the first on."""
        self._counts.clear()
        self._turns = Turns()
        name, known, count = self.frame.name, {**self.frame.once}, 0
        final, seen = self.frame.final, self._roles["observation"]
        leaves = [leaf for role in _SIGNALS for leaf in self._roles.get(role, ())]
        if final and {leaf.column for leaf in seen} <= final.keys():
            chosen = np.stack([_part(final[leaf.column], leaf) for leaf in seen], axis=1)
            known["final_observation"] = self._turned(chosen)
        for where, rows in cut(name, self._rows(), self._layout, self._counts):
            self._turns.see(rows["observation"])
            ends = {what: values[count] for what, values in known.items() if count < len(values)}
            if self._layout.rate and "final_observation" in ends:  # it has a time, too
                following = np.vstack((rows["observation"][1:], ends.pop("final_observation")))
                is_last = np.arange(len(following)) == len(following) - 1
                flags = {flag: is_last * ends.pop(flag) for flag in ENDS if flag in ends}
                rows = {**rows, "next_observation": following, **flags}
            seed = {"seed": ends.pop("seed")} if "seed" in ends else {}
            parts = [*in_parts(rows, self._layout, leaves, self._counts)]
            for i, part in enumerate(parts):
                once = (seed if i == 0 else {}) | (ends if i == len(parts) - 1 else {})
                episode = episode_of(where, part, once)
                self._counts[LAST] += len(part["action"]) - (len(episode.action) if episode else 0)
                if episode:
                    yield episode
            count += 1
        for what, values in known.items():
            if len(values) != count:
                raise InputError(f"{name} has a {what} for {len(values)} episodes, but has {count}")
        for other in self._others:
            yield from other.episodes()

    def _turned(self, seen: Array) -> Array:
        """Observations (n, d) with their angles in [-pi, pi) rad."""
        if not self._angles.any():
            return seen
        for i in np.flatnonzero(np.fmax.reduce(np.abs(seen), axis=0, initial=0) > MOST_RADIANS):
            roles.check_radians(self.name, self._roles["observation"][i])
        turned = seen * self._factors
        return np.where(self._angles, wrapped(turned), turned)

    def _rows(self) -> Iterator[Rows]:
        first, origin, labels = 0, None, dict[Any, int]()
        for batch in self.frame.batches(self._columns):
            if not batch.num_rows:
                continue
            self._check_late()
            numbers = {name: self._array(batch, name, first) for name in self._numeric}
            rows = dict[str, Array]()
            for role, leaves in self._roles.items():
                some = [_part(numbers[leaf.column], leaf) for leaf in leaves if role not in _EXACT]
                some = some or [self._array(batch, leaves[0].column, first, _exact)]
                rows[role] = np.stack(some, axis=1) if role in WIDE else some[0]
                if role not in self._may_miss and rows[role].dtype.kind == "f":
                    self._check(role, rows[role], first)
            if "time" in rows:
                origin = rows["time"][0] if origin is None else origin
                rows["time"] = self._since(rows["time"], origin, first)
            if "episode" in rows and rows["episode"].dtype.kind != "i":
                names = rows["episode"].tolist()
                rows["episode"] = np.array([labels.setdefault(e, len(labels)) for e in names])
            for role in {"observation", "next_observation"} & rows.keys():
                rows[role] = self._turned(rows[role])
            first += batch.num_rows
            self._counts["row", "read"] += batch.num_rows
            yield rows

    def _since(self, times: Array, origin: Any, first: int) -> Array:
        """Times since the first one [s]."""
        with np.errstate(over="ignore", invalid="ignore"):
            since = (times - origin).astype(float)
            apart = np.abs(times.astype(float) - float(origin))
        if not (np.isfinite(apart).all() and (times.dtype.kind == "f" or apart.max() < 2**63)):
            raise InputError(f"{self._at(first)}: times are too far apart: correct them")
        return since * self._second

    def _check_late(self) -> None:
        asked = (*self._layout.observations, *self._layout.actions)
        for name, problem in self.frame.late.items():
            if any(fnmatchcase(name, pattern) for pattern in asked):
                raise InputError(problem)

    def _array(
        self,
        batch: pa.RecordBatch,
        name: str,
        first: int,
        convert: Callable[[pa.Array], pa.Array] | None = None,
    ) -> Array:
        """A column of a batch from a row on, (n,) or (n, numbers of a list); NaN where it is empty.

        It becomes numbers of 64 bits unless there is another way to convert it.
        """
        if name not in batch.schema.names:
            raise InputError(f"{self._at(first)} has no {name!r}, unlike before")
        given, size = batch.column(name), width(self.frame.schema.field(name).type)
        kind = pa.float64() if size is None else pa.list_(pa.float64(), size)
        if given.null_count and (convert or size is not None):
            row = first + int(np.flatnonzero(given.is_null().to_numpy(zero_copy_only=False))[0])
            raise InputError(f"{self._at(row)}: {name!r} has an empty cell: fill it")
        convert = convert or (lambda column: column.cast(kind))
        try:
            column = convert(given)
        except pa.ArrowException:
            for row in range(len(given)):  # which one is it?
                where = f"{self._at(first + row)}: correct {name!r}, or name other columns"
                with refusing(where, (pa.ArrowException,), describe=first_line):
                    convert(given.take([row]))
            raise
        flat = (column if size is None else column.flatten()).to_numpy(zero_copy_only=False)
        return flat if size is None else flat.reshape(len(column), size)

    def _check(self, role: str, values: Array, first: int) -> None:
        """Refuse numbers that are missing."""
        wrong = np.argwhere(~np.isfinite(values.reshape(len(values), -1)))
        for row, column in wrong[:1].tolist():
            where = f"{self._at(first + row)}: {self._roles[role][column].name!r} is empty"
            how = "give `missing`" if role in (*WIDE, "reward") else "correct it"
            raise InputError(f"{where}, or no finite number: {how}, or leave the row out")

    def _at(self, row: int) -> str:
        return f"{self.frame.name}, {self.frame.place(row)}"

    def notes(self) -> list[str]:
        """What is done to the columns."""
        notes, kinds = [*self.frame.notes], self.frame.unusable
        for kind in dict.fromkeys(kinds.values()):
            names = listed([name for name in kinds if kinds[name] == kind])
            notes.append(f"left out, as {kind}: {names}")
        if unused := [name for name in self.frame.schema.names if name not in self._columns]:
            notes.append(f"not used: {listed(unused)}")
        if self._layout.time and not self._layout.rate and self._clock is None:
            notes.append("the clock is uneven: --rate brings the rows to an even one")
        for leaf, turn in zip(self._roles["observation"], self._turns.found(), strict=False):
            is_degrees = turn > MOST_RADIANS
            unit, units = ("deg", DEGREES) if is_degrees else ("rad", RADIANS)
            known = leaf.is_angle or (leaf.feature and leaf.feature.is_angle)
            if turn and not known and leaf.unit in ("", *units):
                given = shlex.join(["--angles", leaf.name, "--units", f"{leaf.name}={unit}"])
                note = f"{leaf.name} jumps by a full turn, {turn:.4g}"
                notes.append(f"{note}: if it is an angle, give {given}")
        if angles := int(self._angles.sum()):
            degrees = int((self._factors != 1).sum())
            note = f"{counted(angles, 'angle')} brought to [-pi, pi) rad"
            notes.append(f"{note}, {degrees} of them from degrees")
        return [*dict.fromkeys(chain(notes, *(other.notes() for other in self._others)))]


def _both(frame: Frame, given: Layout) -> Layout:
    """What the user says, and what the format says where the user says nothing."""
    usual = Layout()
    said = {name: getattr(given, name) for name in Layout.__struct_fields__}
    layout = frame.layout.replace(**{n: v for n, v in said.items() if v != getattr(usual, n)})
    for name in ("gap", "rate"):
        if getattr(layout, name) and not layout.time:
            raise InputError(f"`{name}` needs `time`, the column of times")
    if layout.fill != usual.fill and not layout.rate:
        raise InputError(f"`fill` {layout.fill} needs `rate`: else nothing stands between readings")
    if frame.is_sparse and not (layout.observations and layout.actions and layout.rate):
        names = ", ".join(name for name in frame.schema.names if name != layout.time)
        needed = "give `rate`, `observations` and `actions`, of"
        raise InputError(f"{frame.name} has topics with clocks of their own: {needed} {names}")
    return layout


def _steps(rows: Rows, gap: float | None) -> Array:
    """From row to row within an episode [s], of the first rows."""
    steps = np.diff(rows["time"])
    within = steps <= (gap or np.inf)
    if "episode" in rows:
        within &= np.diff(rows["episode"]) == 0
    return steps[within]


def _exact(column: pa.Array) -> pa.Array:
    """Times or names: whole numbers where they can be, or words."""
    kind = column.type
    if pa.types.is_timestamp(kind):
        return column.cast(pa.timestamp("ns", kind.tz)).cast(pa.int64())
    if pa.types.is_duration(kind):
        return column.cast(pa.duration("ns")).cast(pa.int64())
    if pa.types.is_integer(kind) or pa.types.is_boolean(kind):
        return column.cast(pa.int64())
    is_number = pa.types.is_floating(kind) or pa.types.is_decimal(kind)
    return column.cast(pa.float64() if is_number else pa.string())


def _part(numbers: Array, leaf: Leaf) -> Array:
    return numbers if leaf.place is None else numbers[:, leaf.place]
