"""Frames: rows with named columns in Arrow's types, into which every format is read."""

import stat
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from jbrep.dataset.columns import Array
from jbrep.dataset.layout import Layout
from jbrep.envs.task import MAX_FEATURES, Feature, Task
from jbrep.errors import InputError, listed, refusing
from jbrep.text import slug

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
CHUNK = 1 << 14  # rows read at a time
PEEKED = 200  # rows by which it is known how long lists are


class About(NamedTuple):
    """What a format says of each number of a column; nothing where it is empty."""

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    offsets: tuple[float, ...] = ()  # subtracted already
    features: tuple[Feature, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Rows with named columns."""

    name: str  # for messages and provenance
    label: str  # id of a task made from the data alone
    schema: pa.Schema  # of all columns that can be used
    batches: Callable[[list[str]], Iterator[pa.RecordBatch]]  # of named columns, from the start
    rows: int | None = None  # how many, if that is known
    about: Mapping[str, About] = field(default_factory=dict)  # columns
    unusable: Mapping[str, str] = field(default_factory=dict)  # other columns, and what they are
    late: Mapping[str, str] = field(
        default_factory=dict
    )  # that began after the first rows: an error for each
    layout: Layout = field(default_factory=Layout)  # what its format says of its columns
    after: Mapping[str, str] = field(default_factory=dict)  # observed after the action, by before
    once: Mapping[str, Array] = field(default_factory=dict)  # ends and seed of each episode, (n,)
    final: Mapping[str, Array] = field(default_factory=dict)  # columns after last actions, (n, ...)
    task: Task | None = None  # that it names, if that is known here
    own_reward: str = ""  # what has given the rewards, if not the environment
    why_no_task: str = "it names no environment"
    action_bounds: tuple[Array, Array] | None = None  # (k,) each; infinite where there are none
    max_episode_steps: int | None = None  # of a task made from the data alone
    timestep: float | None = None  # of its clock [s], if its format says it
    is_sparse: bool = False  # whether a row has numbers of some columns only
    place: Callable[[int], str] = "row {}".format  # a row's name in messages, by number from 0
    notes: tuple[str, ...] = ()  # on what its format leaves out


def check_plain(given: Path) -> None:
    """Make sure that a file or folder, which may be a stranger's, leads nowhere else."""
    for path in sorted(given.rglob("*")) if given.is_dir() else [given]:
        kind = path.lstat().st_mode
        if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
            raise InputError(f"{path} must be a plain file: no link, pipe or device is opened")


def label_of(name: str) -> str:
    """A name as the id of a task: of letters, digits, '.', '_' and '-'."""
    return slug(name).strip("-.")[:100] or "imported"


def own_names(name: str, columns: Collection[str]) -> dict[str, str]:
    """Which of a frame's columns are what by their names, by the keys of `ALIASES`."""
    own = dict[str, str]()
    for role, aliases in ALIASES.items():
        present = [alias for alias in aliases if alias in columns]
        if len(present) > 1:
            raise InputError(f"{name} has {' and '.join(present)}: keep one of them")
        if present:
            own[role] = present[0]
    return own


def check_names(name: str, roles: Collection[str], columns: Collection[str]) -> None:
    """Make sure that there is what every data set needs, of these columns."""
    if lacking := [role for role in ("observation", "action") if role not in roles]:
        raise InputError(
            f"{name} has no {lacking[0]}s: for a log, name their columns, as in --actions torque "
            f"--observations 'joint_*'; it has {listed([*columns]) or 'none'}"
        )
    if not {*roles} & {*ENDS, "episode", "step"}:
        raise InputError(
            f"{name} doesn't say where episodes end: add terminations and truncations, or the "
            "number of the episode in each row; for a log, give `time`, `episode` or `length`"
        )


def width(kind: pa.DataType) -> int | None:
    """Numbers of a list in each row; None of what is no list, or one too long to be used."""
    is_list = pa.types.is_fixed_size_list(kind) and kind.list_size <= MAX_FEATURES
    return kind.list_size if is_list else None


def measured(schema: pa.Schema, first: pa.RecordBatch | None) -> pa.Schema:
    """The schema with lists as long as the first one that has numbers."""
    fields = []
    for i, each in enumerate(schema):
        kind = each.type
        if pa.types.is_list(kind) or pa.types.is_large_list(kind):
            sizes = pc.list_value_length(first.column(i)).to_pylist() if first else ()
            kind = pa.list_(kind.value_type, next(filter(None, sizes), 0))
        fields.append(each.with_type(kind))
    return pa.schema(fields)


def units_in(schema: pa.Schema) -> dict[str, About]:
    """The units that columns have in their metadata."""
    units = {each.name: (each.metadata or {}).get(b"unit", b"") for each in schema}
    return {
        name: About(units=(unit.decode(errors="replace"),) * (width(schema.field(name).type) or 1))
        for name, unit in units.items()
        if unit
    }


def frame_of_table(given: Any, name: str) -> Frame:
    """A frame of pandas or polars, or whatever else Arrow takes."""
    with refusing(f"{name} isn't a table", (TypeError, ValueError, pa.ArrowException)):
        table = pa.table(dict(given) if isinstance(given, Mapping) else given).combine_chunks()
        for i, each in enumerate(table.schema):
            if pa.types.is_dictionary(each.type):
                table = table.set_column(i, each.name, _words(table.column(i)))
    schema = measured(table.schema, next(iter(table.slice(0, PEEKED).to_batches()), None))
    return Frame(
        name=name,
        label=label_of(name),
        schema=schema,
        batches=lambda names: iter(table.select(names).to_batches(CHUNK)),
        rows=table.num_rows,
        about=units_in(schema),
    )


def _words(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """A column of categories as its words; polars has them in a type that Arrow can't take from."""
    chunks = [
        pa.DictionaryArray.from_arrays(each.indices, each.dictionary.cast(pa.string()))
        for each in column.chunks
    ]
    return pa.chunked_array([each.dictionary_decode() for each in chunks], pa.string())
