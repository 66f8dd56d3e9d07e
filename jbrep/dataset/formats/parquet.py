"""Parquet tables: a row for each step, a column for each feature."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import Rows, Source, check_kind, check_names, label
from jbrep.dataset.formats.flat import CHUNK, own_names, per_episode, split
from jbrep.dataset.reader import Dataset
from jbrep.envs.task import Feature, Task
from jbrep.errors import InputError, first_line
from jbrep.progress import Progress
from jbrep.records.record import from_plain
from jbrep.records.storage import exists, publish_file, unfinished

_ACTION = re.compile(r"actions?(_\d+)?")
_NOT_FEATURES = re.compile(r"__index_level_\d+__|seed")  # pandas writes the former


def open_source(given: str) -> Source:
    """Open a Parquet file, and the one of its episodes if it stands beside it.

    Raises:
        InputError: it can't be read, or has no columns that can be used.
    """
    name, path = given, Path(given)
    with _reading(path):
        schema, rows = pq.read_schema(path), pq.read_metadata(path).num_rows
    task = _own_task(schema)
    own = own_names(name, schema.names)
    actions = [column for column in schema.names if _ACTION.fullmatch(column)]
    if task:
        features = list(task.feature_names)
    else:
        others = {*own.values(), *actions}
        features = [n for n in schema.names if n not in others and not _NOT_FEATURES.fullmatch(n)]
    columns = {column: [given] for column, given in own.items()}
    columns |= {"observation": features, "action": actions}
    check_names(name, [column for column, given in columns.items() if given])
    _check_types(name, schema, columns)
    once = _once(path)
    named = () if task else tuple(Feature(_word(column)) for column in features)
    return Source(
        name,
        label(path.stem),
        lambda: split(name, _chunks(path, columns), once),
        task=task,
        features=named,
        rows=rows,
    )


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Say of a file that it can't be read."""
    try:
        yield
    except InputError:
        raise
    except (OSError, KeyError, ValueError, pa.ArrowException) as error:
        reason = first_line(error)
        raise InputError(f"{path} can't be read as a Parquet file: {reason}") from None


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
            check_kind(name, what, dtype)


def _chunks(path: Path, columns: dict[str, list[str]]) -> Iterator[Rows]:
    wanted = [given for group in columns.values() for given in group]
    with _reading(path), pq.ParquetFile(path) as file:
        for batch in file.iter_batches(CHUNK, columns=wanted):
            _check_full(path, batch)
            yield {name: _array(name, batch, given) for name, given in columns.items()}


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


def _once(path: Path) -> dict[str, NDArray[Any]]:
    """What the file of episodes that jbrep exports beside it says, if there is one."""
    beside = path.with_stem(f"{path.stem}-episodes")
    if not exists(beside):
        return {}
    with _reading(beside):
        table = pq.read_table(beside)
        final = np.stack(table["final_observation"].to_numpy())
        once = {name: table[name].to_numpy() for name in ("terminated", "seed")}
        return per_episode(str(beside), {"final_observation": final, **once})


def _word(column: str) -> str:
    """The name of a column as a feature's."""
    word = re.sub(r"[^A-Za-z0-9_.-]", "_", column)
    return word if word[:1].isalpha() else f"obs_{word}"


def write(dataset: Dataset, out: Path) -> str:
    """Write a file of steps, and beside it one of episodes; returns how to open them."""
    episodes = out.with_stem(f"{out.stem}-episodes")
    with unfinished(out) as partial, unfinished(episodes) as partial_episodes:
        _write_steps(dataset, partial, out.name)
        columns = {name: list(values) for name, values in dataset.episodes.items()}
        pq.write_table(pa.table(columns), partial_episodes)
        publish_file(partial_episodes, episodes)
        try:
            publish_file(partial, out)
        except BaseException:
            episodes.unlink()
            raise
    return f"pandas.read_parquet({str(out)!r}), and {episodes.name} for the episodes"


def _write_steps(dataset: Dataset, path: Path, name: str) -> None:
    """The settings are in the file's metadata, the units in the columns'."""
    schema = pa.schema(
        [
            pa.field(name, pa.from_numpy_dtype(dtype), nullable=False, metadata={"unit": unit})
            for name, dtype, unit in _numeric_columns(dataset)
        ],
        metadata={"jbrep": json.dumps(dataset.manifest.settings.as_json())},
    )
    coding = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": True}
    with pq.ParquetWriter(path, schema, **coding) as writer:
        chunks = zip(*(dataset[name].chunks() for name in dataset.columns), strict=True)
        for chunk in Progress(chunks, unit="chunk", desc=name, leave=False):
            arrays = [numbers for values in chunk for numbers in values.reshape(len(values), -1).T]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))


def _numeric_columns(dataset: Dataset) -> Iterator[tuple[str, np.dtype[Any], str]]:
    """Name, type and unit of each column of numbers, in the order of the data set's columns."""
    for name in dataset.columns:
        column = dataset[name]
        if name == "observation":
            for feature in dataset.task.features:
                yield feature.name, column.dtype, feature.unit
        elif column.shape[1:] in ((), (1,)):
            yield name, column.dtype, "1"
        else:
            for i in range(column.shape[1]):
                yield f"{name}_{i}", column.dtype, ""
