"""Importing a Parquet table: a row for each step, a column for each feature."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from jbrep.dataset.importing.arrays import label
from jbrep.dataset.importing.episodes import Incoming, Source, check_kinds
from jbrep.dataset.importing.flat import (
    ALIASES,
    CHUNK,
    PerEpisode,
    Rows,
    check_columns,
    own_names,
    split,
)
from jbrep.envs.task import Feature, Task
from jbrep.errors import InputError, first_line
from jbrep.records.record import from_plain
from jbrep.records.storage import exists

_ACTION = re.compile(r"actions?(_\d+)?")
_NOT_FEATURES = re.compile(r"__index_level_\d+__|seed")  # pandas writes the former


def open_file(path: Path) -> Source:
    """Open a Parquet file, and the one of its episodes if it stands beside it.

    Raises:
        InputError: it can't be read, or has no columns that can be used.
    """
    name = str(path)
    schema = _schema(path)
    task = _own_task(schema)
    own = own_names(name, schema.names)
    actions = [column for column in schema.names if _ACTION.fullmatch(column)]
    if task:
        features = list(task.feature_names)
    else:
        others = {*own.values(), *actions}
        features = [n for n in schema.names if n not in others and not _NOT_FEATURES.fullmatch(n)]
    scalars = {n: c for n, c in own.items() if n in ALIASES and n not in ("observation", "action")}
    check_columns(
        name,
        [*scalars, *(["observation"] if features else []), *(["action"] if actions else [])],
    )
    columns = {"observation": features, "action": actions}
    columns |= {column: [given] for column, given in scalars.items()}
    _check_types(name, schema, columns)
    once = _once(path)

    def episodes() -> Iterator[Incoming]:
        return split(name, _chunks(path, columns), once)

    named = () if task else tuple(Feature(_word(column)) for column in features)
    rows = pq.read_metadata(path).num_rows
    return Source(name, label(path.stem), episodes, task=task, features=named, rows=rows)


def _schema(path: Path) -> pa.Schema:
    try:
        return pq.read_schema(path)
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: BaseException) -> InputError:
    return InputError(f"{path} can't be read as a Parquet file: {first_line(error)}")


def _own_task(schema: pa.Schema) -> Task | None:
    """The task in what jbrep exported; None of any other file."""
    try:
        task = from_plain(json.loads((schema.metadata or {})[b"jbrep"])["environment"], Task)
    except (KeyError, ValueError, TypeError, RecursionError):
        return None
    return task if set(task.feature_names) <= set(schema.names) else None


def _check_types(name: str, schema: pa.Schema, columns: dict[str, list[str]]) -> None:
    for what, given in columns.items():
        for column in given:
            try:
                dtype = np.dtype(schema.field(column).type.to_pandas_dtype())
            except NotImplementedError:
                dtype = np.dtype(object)
            if dtype.kind not in "fiub":
                raise InputError(
                    f"{name} has {schema.field(column).type} in the column {column!r}: it must be "
                    "plain numbers"
                )
            check_kinds(name, {what: (dtype, ())})


def _chunks(path: Path, columns: dict[str, list[str]]) -> Iterator[Rows]:
    wanted = [given for group in columns.values() for given in group]
    try:
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(CHUNK, columns=wanted):
                _check_full(path, batch)
                yield {name: _array(name, batch, given) for name, given in columns.items()}
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, error) from None


def _check_full(path: Path, batch: pa.RecordBatch) -> None:
    for column, values in zip(batch.schema.names, batch.columns, strict=True):
        if values.null_count:
            raise InputError(
                f"{path} has empty cells in the column {column!r}: fill them, or leave the "
                "episode out"
            )


def _array(name: str, batch: pa.RecordBatch, columns: list[str]) -> NDArray[Any]:
    arrays = [batch.column(column).to_numpy(zero_copy_only=False) for column in columns]
    return np.stack(arrays, axis=1) if name in ("observation", "action") else arrays[0]


def _once(path: Path) -> PerEpisode:
    """What the file of episodes that jbrep exports beside it says, if there is one."""
    beside = path.with_stem(f"{path.stem}-episodes")
    if not exists(beside):
        return PerEpisode()
    try:
        table = pq.read_table(beside)
        table = table.filter(pc.greater(table["length"], 0))
        final = np.stack(table["final_observation"].to_numpy())
        once = {name: table[name].to_numpy() for name in ("terminated", "seed")}
        return PerEpisode.of(str(beside), {"final_observation": final, **once})
    except (OSError, KeyError, ValueError, pa.ArrowException) as error:
        raise _unreadable(beside, error) from None


def _word(column: str) -> str:
    """The name of a column as a feature's."""
    word = re.sub(r"[^A-Za-z0-9_.-]", "_", column)
    return word if word[:1].isalpha() else f"obs_{word}"
