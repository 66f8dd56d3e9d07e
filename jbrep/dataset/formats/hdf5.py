"""HDF5 files of D4RL's layout, and of robomimic's; nothing in them is unpickled.

D4RL's have a row for each step of all episodes: `observations`, `actions`, `rewards`, `terminals`
and `timeouts`. Robomimic's have a group for each episode, `data/demo_0` and so on, with `actions`,
`rewards`, `dones`, and in `obs` and `next_obs` an array for each thing that is observed.
"""

import json
import math
from bisect import bisect
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import check_kind, check_lengths, label
from jbrep.dataset.formats.flat import CHUNK, own_names
from jbrep.dataset.formats.tables import NAMES, Table, width
from jbrep.dataset.layout import Layout
from jbrep.envs.task import MAX_FEATURES
from jbrep.errors import InputError, listed, refusing
from jbrep.text import counted

Array = NDArray[Any]

_MOST_AT_ONCE = 1 << 30  # bytes of an array
_SQUEEZED = 2000  # times that one of HDF5's filters may make an array smaller, at most
_SQUEEZING = {"deflate": h5py.h5z.FILTER_DEFLATE, "lzf": h5py.h5z.FILTER_LZF}
_OF_ONE_SIZE = {"shuffle": h5py.h5z.FILTER_SHUFFLE, "fletcher32": h5py.h5z.FILTER_FLETCHER32}
_IMAGE_AXES = 4  # steps, height, width, colour
_NOW, _NEXT = "obs/", "next_obs/"
_ROWS = ("actions", "rewards", "dones")


@contextmanager
def opened(path: Path, *, whole: bool = False) -> Iterator[h5py.File]:
    """An HDF5 file, all of whose contents are in itself.

    Args:
        path: of the file.
        whole: whether each array will be read at once, rather than some rows at a time.
    """
    with refusing(f"{path} can't be read as an HDF5 file"), h5py.File(path) as file:
        if problem := file.visititems_links(partial(_problem, file, whole)):
            raise InputError(f"{path}: {problem}")
        yield file


def _problem(file: h5py.File, whole: bool, name: str, link: Any) -> str | None:
    """Why a name in a file isn't read."""
    if not isinstance(link, h5py.HardLink):
        return f"{name} is a link, which isn't followed"
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        return None
    if found.external or found.is_virtual:
        return f"{name} is in another file, which isn't opened"
    stored, size = found.id.get_storage_size(), found.nbytes
    at_once = size if whole else math.prod(found.chunks or (0,)) * found.dtype.itemsize
    if size > _SQUEEZED * (stored + 1) or at_once > _MOST_AT_ONCE:
        return (
            f"{name} would have {size:,} bytes, of which {stored:,} are stored: at most "
            f"{_MOST_AT_ONCE:,} are possible, and what is stored"
        )
    return _problem_of_chunks(name, found) if found.chunks else None


def _problem_of_chunks(name: str, array: h5py.Dataset) -> str | None:
    """Why an array's chunks aren't read: far more could come out of them than they are to hold."""
    settings, squeezing = array.id.get_create_plist(), {*_SQUEEZING.values()}
    filters = [settings.get_filter(i)[0] for i in range(settings.get_nfilters())]
    may_be = squeezing | {*_OF_ONE_SIZE.values()}
    if not may_be >= {*filters} or len({*filters}) < len(filters) or squeezing <= {*filters}:
        return (
            f"{name} has filters other than {' or '.join(_SQUEEZING)}, once, and "
            f"{' and '.join(_OF_ONE_SIZE)}: write it again with these"
        )
    size = math.prod(array.chunks) * array.dtype.itemsize
    most = 2 * size + 4096  # what can't be squeezed grows a little
    found: str | None = array.id.chunk_iter(
        lambda chunk: (
            f"{name} has {chunk.size:,} bytes for a chunk of {size:,}"
            if chunk.size > most
            else None
        )
    )
    return found


class _Part(NamedTuple):
    """Rows that stand together in a file: all of D4RL's, or those of a demo of robomimic's."""

    name: str  # for messages, before a row's number
    rows: int
    arrays: Mapping[str, str]  # their paths in the file, by the names of columns
    made: Mapping[str, Array]  # columns that aren't in the file


def open_table(given: str) -> Table:
    """Open a file of either layout."""
    path = Path(given)
    with opened(path) as file:
        demos = _demos(file)
        return _of_robomimic(path, file, demos) if demos else _of_d4rl(path, file)


def _demos(file: h5py.File) -> list[str]:
    """The groups of robomimic's demos, in the order of their numbers."""
    data = file.get("data")
    if not isinstance(data, h5py.Group):
        return []
    names = [n for n in data if isinstance(data[n], h5py.Group) and "actions" in data[n]]
    return [f"data/{name}" for name in sorted(names, key=lambda name: (len(name), name))]


def _arrays(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """The arrays of numbers with rows, by their paths in a group."""
    found: dict[str, h5py.Dataset] = {}

    def visit(name: str, each: Any) -> None:
        if isinstance(each, h5py.Dataset) and each.shape and each.dtype.kind in "fiub":
            found[name] = each

    group.visititems(visit)
    return found


def _of_d4rl(path: Path, file: h5py.File) -> Table:
    arrays = _arrays(file)
    own = own_names(str(path), arrays)
    if not {"observation", "action"} <= own.keys():
        raise InputError(
            f"{path} has neither observations and actions, as D4RL's files do, nor data/demo_0 and "
            "so on with actions, as robomimic's"
        )
    check_lengths(str(path), {column: len(arrays[name]) for column, name in own.items()})
    observations = arrays[own["observation"]]
    check_kind(str(path), "observation", observations.dtype, observations.shape[1:])
    rows = len(observations)
    fitting = {name: each for name, each in arrays.items() if len(each) == rows}
    part = _Part("row", rows, {name: name for name in fitting}, {})
    others = arrays.keys() - fitting.keys()
    notes = [f"not a row for each step: {listed(sorted(others))}"] if others else []
    return _table(path, [part], fitting, notes)


def _of_robomimic(path: Path, file: h5py.File, demos: list[str]) -> Table:
    parts, early = list[_Part](), 0
    for number, name in enumerate(demos):
        arrays = _arrays(file[name])
        lengths = {n[:-1]: len(arrays[n]) for n in _ROWS if n in arrays}
        told = {f"{n} row": len(e) for n, e in arrays.items() if n.startswith((_NOW, _NEXT))}
        check_lengths(f"{path}, {name}", lengths | told)
        rows = lengths.get("action", 0)
        ends = np.zeros(rows, bool)
        if "dones" in arrays:
            done = arrays["dones"]
            check_kind(f"{path}, {name}", "done", done.dtype, done.shape[1:])
            ends = np.ravel(done) > 0
        early += int(ends[:-1].sum())
        ends[:-1] = False
        paths = {_column(n, arrays): f"{name}/{n}" for n, e in arrays.items() if len(e) == rows}
        made = {"episode": np.full(rows, number), "terminated": ends}
        parts.append(_Part(f"{name}, step", rows, paths, made))
    first = {name: file[each] for name, each in parts[0].arrays.items() if name != "dones"}
    arrays = _arrays(file[demos[0]])
    seen = [_column(n, arrays) for n in arrays if n.startswith(_NOW)]
    seen = [name for name in seen if name in first and not _is_image(first[name])]
    note = f"{counted(early, 'step')} done before the end of a demo: the episode goes on there"
    table = _table(path, parts, first, [note] if early else [])
    name, timestep = _environment(file["data"].attrs.get("env_args"))
    return replace(
        table,
        label=label(name) if name else table.label,
        timestep=timestep,
        layout=Layout(observations=tuple(seen) or (_NOW,), actions=("actions",)),
        after={name: f"{_NEXT}{name.removeprefix(_NOW)}" for name in seen},
    )


def _column(name: str, others: Collection[str]) -> str:
    """What an array of a demo is called: as robomimic calls what is observed, if nothing else is.

    What was done before, `obs/actions`, isn't what is done then, `actions`.
    """
    short = name.removeprefix(_NOW)
    return name if short in others else short


def _environment(told: Any) -> tuple[str, float | None]:
    """Name and time step [s] of robomimic's environment, as far as they are known."""
    try:
        known = json.loads(told)
        rate = known.get("env_kwargs", {}).get("control_freq")
        return str(known["env_name"]), 1 / rate if rate else None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return "", None


def _is_image(array: h5py.Dataset) -> bool:
    """Whether it is one, or has as many numbers in a row."""
    if math.prod(array.shape[1:]) > MAX_FEATURES:
        return True
    return array.ndim >= _IMAGE_AXES or (array.ndim == _IMAGE_AXES - 1 and array.dtype == np.uint8)


def _table(
    path: Path, parts: Sequence[_Part], first: Mapping[str, h5py.Dataset], notes: Sequence[str]
) -> Table:
    """The rows of all parts, with the columns of the first."""
    images = sorted(name for name, each in first.items() if _is_image(each))
    kinds = {n: _kind(each.dtype, each.shape[1:]) for n, each in first.items() if n not in images}
    kinds |= {n: _kind(each.dtype, ()) for n, each in parts[0].made.items()}
    schema = pa.schema(_named(name, kind) for name, kind in kinds.items())
    ends = list(accumulate(part.rows for part in parts))

    def place(row: int) -> str:
        number = min(bisect(ends, row), len(parts) - 1)
        return f"{parts[number].name} {row - ends[number] + parts[number].rows}"

    left_out = [f"images are left out: {listed(images)}"] if images else []
    return Table(
        str(path),
        label(path.stem),
        schema,
        partial(_batches, path, parts, schema),
        rows=ends[-1],
        place=place,
        notes=(*notes, *left_out),
    )


def _kind(dtype: np.dtype[Any], row: Sequence[int]) -> pa.DataType:
    """The type of a column whose rows have such a shape."""
    kind = pa.from_numpy_dtype(dtype.newbyteorder("="))
    kind = pa.float32() if pa.types.is_float16(kind) else kind
    return pa.list_(kind, math.prod(row)) if tuple(row) not in ((), (1,)) else kind


def _named(name: str, kind: pa.DataType) -> pa.Field:
    """A column; the numbers of one in a group are named without the group."""
    size, short = width(kind), name.rpartition("/")[2]
    names = [short] if size is None else [f"{short}_{i}" for i in range(size)]
    return pa.field(name, kind, metadata={NAMES: "\n".join(names)} if "/" in name else None)


def _batches(
    path: Path, parts: Sequence[_Part], schema: pa.Schema, columns: list[str]
) -> Iterator[pa.RecordBatch]:
    """The rows of some columns, some at a time."""
    fields = [schema.field(name) for name in columns]
    with opened(path) as file:
        for part in parts:
            for begin in range(0, part.rows, CHUNK):
                rows = slice(begin, min(begin + CHUNK, part.rows))
                arrays = [_read(path, file, part, each, rows) for each in fields]
                yield pa.RecordBatch.from_arrays(arrays, names=columns)


def _read(path: Path, file: h5py.File, part: _Part, column: pa.Field, rows: slice) -> pa.Array:
    """Some rows of a column."""
    if column.name in part.made:
        return pa.array(part.made[column.name][rows])
    where = part.arrays.get(column.name)
    array = file[where] if where else None
    if array is None or _kind(array.dtype, array.shape[1:]) != column.type:
        has = "no" if array is None else f"{array.dtype} of shape {array.shape[1:]} in"
        raise InputError(
            f"{path}, {part.name} 0: {has} {column.name!r}, unlike before: it must be {column.type}"
        )
    size = width(column.type)
    values = pa.array(np.ravel(array[rows]).astype(array.dtype.newbyteorder("=")))
    values = values.cast(column.type if size is None else column.type.value_type)
    return values if size is None else pa.FixedSizeListArray.from_arrays(values, size)
