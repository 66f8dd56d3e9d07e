"""Tables: rows with named columns, of which a layout says what they are to a data set."""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import ALIASES, WHOLE, WIDE, check_kind, check_names
from jbrep.dataset.formats.flat import own_names
from jbrep.dataset.layout import Layout
from jbrep.envs.names import is_code
from jbrep.envs.task import MAX_FEATURES, Feature, Task
from jbrep.errors import InputError, matching
from jbrep.text import words

Array = NDArray[Any]

PEEKED = 200  # rows by which lists are known
UNIT = b"unit"  # in a field's metadata
NAMES, OFFSETS = b"names", b"offsets"  # of its numbers, in lines: names, and what they lack already
_ACTION = re.compile(r"actions?(_\d+)?")
_NOT_FEATURES = re.compile(r"__index_level_\d+__|seed")  # pandas writes the former
DEGREES = ("deg", "°", "degrees", "degree")
RADIANS = ("", "rad")
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}  # by unit
_WORDS = (
    *(pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view),
    pa.types.is_dictionary,
)
_TIMES = pa.types.is_timestamp, pa.types.is_duration


@dataclass(frozen=True)
class Table:
    """Rows with named columns, in Arrow's types.

    Attributes:
        name: for messages and provenance.
        label: for a task made from the data alone.
        schema: of all columns; a field's metadata may say its unit, and a list's names.
        batches: of some columns by name, from the first row on at each call.
        rows: how many there are, if that is known.
        layout: what its format says of its columns.
        task, once: what it knows besides, see `Source` and `per_episode`.
        after: columns with what was observed after the action, by those with what was before it.
        place: what a row is called in messages, by its number from 0.
        timestep: of its clock, if its format says it [s].
        is_sparse: whether a row has numbers of some columns only.
        late: of columns that came up after the schema was known, what is wrong with them, for
            messages: they can't be used.
        notes: on what its format leaves out.
    """

    name: str
    label: str
    schema: pa.Schema
    batches: Callable[[list[str]], Iterator[pa.RecordBatch]]
    rows: int | None = None
    layout: Layout = field(default_factory=Layout)
    task: Task | None = None
    once: Mapping[str, Array] = field(default_factory=dict)
    after: Mapping[str, str] = field(default_factory=dict)
    place: Callable[[int], str] = lambda row: f"row {row}"
    timestep: float | None = None
    is_sparse: bool = False
    late: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class Leaf(NamedTuple):
    """A number of each row: a column, or a part of a column of lists."""

    name: str
    short: str  # the name for a feature, unless two are the same
    column: str
    place: int | None = None  # in a list
    unit: str = ""
    is_angle: bool = False
    subtracted: float = 0.0  # already


Roles = Mapping[str, list[Leaf]]  # by the names of ALIASES, and time


def _leaves(table: Table, units: Mapping[str, str]) -> list[Leaf]:
    """All that could be used of a table, in units by names or patterns, or else its own."""
    leaves = list(_own_leaves(table.schema))
    for name, unit in units.items():
        some = {each.name for each in _matching(table, leaves, (name,))}
        leaves = [each._replace(unit=unit) if each.name in some else each for each in leaves]
    return leaves


def _own_leaves(schema: pa.Schema) -> Iterator[Leaf]:
    for each in schema:
        said = {key: text.decode(errors="replace") for key, text in (each.metadata or {}).items()}
        size = width(each.type)
        if size is not None and size > MAX_FEATURES:
            size = None  # it can't be used, and is refused if it is named
        count = 1 if size is None else size
        names = said[NAMES].split("\n") if NAMES in said else []
        offsets = map(float, said[OFFSETS].split("\n")) if OFFSETS in said else [0.0] * count
        for i, offset in zip(range(count), offsets, strict=True):
            name, short, place = each.name, names[0] if names else each.name, None
            if size is not None:
                place, short = i, names[i] if names else f"{each.name}_{i}"
                name = f"{each.name}.{names[i] if names else i}"
            unit = said.get(UNIT, "")
            yield Leaf(name, short, each.name, place, unit, subtracted=offset)


def with_widths(schema: pa.Schema, first: pa.RecordBatch | None) -> pa.Schema:
    """The schema of a file: lists as long as the first one that has numbers, and units alone."""
    for i, each in enumerate(schema):
        units = {name: text for name, text in (each.metadata or {}).items() if name == UNIT}
        schema = schema.set(i, each := each.with_metadata(units))
        if pa.types.is_list(each.type) or pa.types.is_large_list(each.type):
            sizes = pc.list_value_length(first.column(i)).to_pylist() if first else ()
            size = next(filter(None, sizes), 0)
            schema = schema.set(i, each.with_type(pa.list_(each.type.value_type, size)))
    return schema


def with_offsets(schema: pa.Schema, name: str, offsets: Sequence[float]) -> pa.Schema:
    """The schema with what a column's numbers lack already."""
    i = schema.get_field_index(name)
    lines = "\n".join(map(repr, offsets)).encode()
    known = schema.field(i).metadata or {}
    return schema.set(i, schema.field(i).with_metadata({**known, OFFSETS: lines}))


def width(kind: pa.DataType) -> int | None:
    """Numbers of a list in each row; None of what is no list."""
    return kind.list_size if pa.types.is_fixed_size_list(kind) else None


def sort_of(kind: pa.DataType) -> str:
    """What a column holds: a number, words, a list of numbers or something else."""
    is_number = pa.types.is_integer(kind) or pa.types.is_floating(kind)
    if is_number or pa.types.is_boolean(kind) or pa.types.is_decimal(kind):
        return "number"
    if any(each(kind) for each in (pa.types.is_list, pa.types.is_large_list)) or width(kind):
        return f"list of {sort_of(kind.value_type)}"
    return "word" if any(each(kind) for each in _WORDS) else str(kind)


def roles_of(table: Table, layout: Layout) -> Roles:
    """Which columns are what, by the layout, or else by their names."""
    name, names = table.name, table.schema.names
    if twice := [each for each, n in Counter(names).items() if n > 1]:
        raise InputError(f"{name} has two columns {twice[0]!r}: rename one")
    leaves = _leaves(table, layout.units)
    roles = {role: _matching(table, leaves, said) for role, said in _said(table, layout).items()}
    roles.setdefault("action", [each for each in leaves if _ACTION.fullmatch(each.column)])
    roles.setdefault("observation", list(_others(table, leaves, roles)))
    angles = _matching(table, roles["observation"], layout.angles, "observation")
    roles["observation"] = [each._replace(is_angle=each in angles) for each in roles["observation"]]
    if layout.observations:
        roles["next_observation"] = _after(table, leaves, roles["observation"])
    roles = {role: some for role, some in roles.items() if some}
    check_names(name, [*roles, *(["step"] if layout.time or layout.length else [])], names)
    for role, some in roles.items():
        _check_types(table, role, some, named=bool(layout.actions))
    return roles


def _said(table: Table, layout: Layout) -> dict[str, tuple[str, ...]]:
    """The names of columns by what they are."""
    names = table.schema.names
    said = {role: (own,) for role, own in own_names(table.name, names).items()}
    once = {role: getattr(layout, role) for role in ("time", "episode", "terminated")}
    once["reward"] = layout.reward if not is_code(layout.reward) else ""
    if layout.time:  # which tells more than the numbers of steps
        said.pop("step", None)
    if is_code(layout.reward):
        said.pop("reward", None)
    said |= {role: (given,) for role, given in once.items() if given}
    wide = {"action": layout.actions, "observation": layout.observations}
    return said | {role: given for role, given in wide.items() if given}


def _after(table: Table, leaves: list[Leaf], seen: list[Leaf]) -> list[Leaf]:
    """The columns of the same after the action; none if one is missing."""
    after = {**{name: f"next_{name}" for name in ALIASES["observation"]}, **table.after}
    places = {(each.column, each.place): each for each in leaves}
    found = [places.get((after.get(each.column, ""), each.place)) for each in seen]
    return [each for each in found if each] if all(found) else []


def _others(table: Table, leaves: list[Leaf], roles: Roles) -> Iterator[Leaf]:
    """The columns that are nothing else."""
    if table.task:
        yield from _matching(table, leaves, table.task.feature_names)
        return
    taken = {each.name for some in roles.values() for each in some}
    own = {*own_names(table.name, table.schema.names).values()}  # also where another is named
    for each in leaves:
        if not (each.name in taken or each.column in own or _NOT_FEATURES.fullmatch(each.column)):
            yield each


def is_of_task(table: Table, roles: Roles) -> bool:
    """Whether observations and actions are those of the table's task, in its order.

    Those that are said to be angles, or in other units, are others.
    """
    if not table.task or any(each.is_angle for each in roles["observation"]):
        return False
    seen = [(each.name, each.unit) for each in roles["observation"]]
    actions = [table.schema.get_field_index(each.column) for each in roles["action"]]
    known = [(each.name, each.unit) for each in table.task.features]
    return seen == known and actions == sorted(actions)


def _matching(
    table: Table, leaves: list[Leaf], names: tuple[str, ...], what: str = "column"
) -> list[Leaf]:
    """Those of such names, in the order of the names and each once."""
    own, columns = [each.name for each in leaves], [each.column for each in leaves]
    return [leaves[i] for i in matching(names, own, columns, f"{table.name} has no {what}")]


def _check_types(table: Table, role: str, leaves: list[Leaf], named: bool) -> None:
    """Make sure that columns can be what they are said to be."""
    if role not in WIDE and len(leaves) > 1:
        raise InputError(f"{table.name} has {len(leaves)} columns of the {role}: it must be one")
    check_kind(table.name, role, np.dtype(int if role in WHOLE else float), (len(leaves),))
    for each in leaves:
        kind = table.schema.field(each.column).type
        kind = kind if each.place is None else kind.value_type
        beside = {"time": _TIMES, "episode": _WORDS}.get(role, ())  # what it may be but a number
        if any(each(kind) for each in beside):
            continue
        if role == "time" and (pa.types.is_temporal(kind) or pa.types.is_boolean(kind)):
            raise InputError(
                f"{table.name} has {kind} in the column {each.column!r}: times must be numbers, "
                "timestamps or durations"
            )
        if sort_of(kind) != "number":
            raise InputError(
                f"{table.name} has {kind} in the column {each.column!r}: it must be plain numbers"
                + ("; or name the observations and actions without it" if role in WIDE else "")
            )
        if role == "action" and not named and not pa.types.is_floating(kind):
            raise InputError(
                f"{table.name} has {kind} in the column {each.column!r}: only continuous actions "
                "are possible; if these are, name the actions"
            )


def features_of_table(table: Table, leaves: list[Leaf]) -> Iterator[Feature]:
    """The features by the names and units of their columns."""
    shorts = Counter(each.short for each in leaves)
    names = words(each.short if shorts[each.short] == 1 else each.name for each in leaves)
    for each, name in zip(leaves, names, strict=True):
        if not each.is_angle:
            yield Feature(name=name, unit=each.unit[:40])
        elif each.unit in (*RADIANS, *DEGREES):
            pi = math.pi
            yield Feature(name=name, unit="rad", low=-pi, high=pi, bounded=True, kind="angle")
        else:
            raise InputError(
                f"{table.name} has the angle {each.name!r} in {each.unit!r}: it must be in rad or "
                "deg"
            )
