"""Exporting to Parquet: a row for each control step, a column for each feature."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from jbrep.dataset import Dataset
from jbrep.progress import Progress
from jbrep.records.publish import publish_file, unfinished


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
            arrays = [column for values in chunk for column in _flat(values)]
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


def _flat(values: NDArray[Any]) -> list[NDArray[Any]]:
    """The columns of (n,) or (n, k)."""
    return list(values.reshape(len(values), -1).T)
