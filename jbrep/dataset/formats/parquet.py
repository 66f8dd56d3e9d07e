"""Parquet tables: a row for each step, a column for each feature."""

import json
import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jbrep.dataset.formats import frame
from jbrep.dataset.formats.frame import About, Frame, check_plain, label_of, measured, units_in
from jbrep.dataset.reader import Dataset
from jbrep.envs.task import Task
from jbrep.errors import InputError, first_line, refusing
from jbrep.progress import Progress
from jbrep.records.document import parse_json
from jbrep.records.record import from_plain
from jbrep.records.storage import exists, publish, unfinished

_SETTINGS = b"jbrep"  # of the data set, in the metadata of a table that was exported


def read(given: str) -> Frame:
    """Read a table, and the one of its episodes if jbrep exported it."""
    path = Path(given)
    with opened(path) as file:
        rows, metadata = file.metadata.num_rows, file.metadata.metadata or {}
        schema = measured(file.schema_arrow, next(file.iter_batches(frame.PEEKED), None))
        own = _exported(path, schema, metadata[_SETTINGS]) if _SETTINGS in metadata else {}
    return Frame(
        **{"name": given, "label": label_of(path.stem), "about": units_in(schema), **own},
        schema=schema,
        batches=lambda columns: batches_of([path], columns),
        rows=rows,
    )


@contextmanager
def opened(path: Path) -> Iterator[pq.ParquetFile]:
    """A file of any name, whose pages' checksums are compared."""
    errors = (OSError, KeyError, TypeError, ValueError, pa.ArrowException)
    with (
        refusing(f"{path} can't be read as a Parquet file", errors, describe=first_line),
        path.open("rb") as file,
        pq.ParquetFile(file, page_checksum_verification=True) as table,
    ):
        yield table


def batches_of(paths: list[Path], columns: list[str]) -> Iterator[pa.RecordBatch]:
    """The rows of some columns, in one file after the other."""
    for path in paths:
        with opened(path) as file:
            yield from file.iter_batches(frame.CHUNK, columns=columns)


def _exported(path: Path, schema: pa.Schema, settings: bytes) -> dict[str, Any]:
    """What a frame has besides, of a table that jbrep exported."""
    known = parse_json(settings, path, "jbrep")
    task = from_plain(known["environment"], Task)
    if not {*task.feature_names} <= {*schema.names}:
        return {}
    beside = _beside(path)
    if not exists(beside):
        raise InputError(f"{beside} is missing: it belongs to {path}, and must stand beside it")
    check_plain(beside)
    with opened(beside) as file:
        episodes = file.read()
        final = np.stack(episodes["final_observation"].to_numpy()).astype(np.float64)
        once = {name: episodes[name].to_numpy() for name in frame.ENDS}
        once["seed"] = np.array(episodes["seed"].to_pylist(), np.int64)
        lengths = episodes["length"].to_numpy()
    with opened(path) as file:
        counts = np.bincount(file.read(["episode"])["episode"].to_numpy())
    if not np.array_equal(counts, lengths):
        raise InputError(
            f"{beside} has episodes of other lengths than {path}: both must be of one export"
        )
    offsets = zip(task.features, task.offset.tolist(), strict=True)
    return {
        "task": task,
        "own_reward": known.get("reward", ""),
        "once": once,
        "final": dict(zip(task.feature_names, final.T, strict=True)),
        "about": {each.name: About(units=(each.unit,), offsets=(by,)) for each, by in offsets},
    }


def _beside(path: Path) -> Path:
    return path.with_stem(f"{path.stem}-episodes")


def write(dataset: Dataset, out: Path) -> str:
    """Write a file of steps, and beside it one of episodes; returns how to open them."""
    with unfinished(out) as partial, unfinished(_beside(out)) as episodes:
        columns = {name: list(values) for name, values in dataset.episodes.items()}
        pq.write_table(pa.table(columns), episodes, write_page_checksum=True)
        _write_steps(dataset, partial, out.name)
        publish(episodes, _beside(out))
        publish(partial, out)
    return f"pandas.read_parquet({str(out)!r}); episodes: {_beside(out).name}"


def _write_steps(dataset: Dataset, path: Path, name: str) -> None:
    """The settings are in the file's metadata, the units in the columns'."""
    fields = list[pa.Field]()
    for column in dataset.columns:
        kind = pa.from_numpy_dtype(dataset[column].dtype)
        size = math.prod(dataset[column].shape[1:])
        units = {column: "1"} if size == 1 else {f"{column}_{i}": "" for i in range(size)}
        if column == "observation":
            units = {feature.name: feature.unit for feature in dataset.task.features}
        fields += [
            pa.field(each, kind, nullable=False, metadata={"unit": unit})
            for each, unit in units.items()
        ]
    schema = pa.schema(fields, {_SETTINGS: json.dumps(dataset.manifest.settings.as_json())})
    if twice := [each for each, n in Counter(schema.names).items() if n > 1]:
        raise InputError(
            f"{dataset.folder} has a feature {twice[0]!r}, which is the name of another column of "
            "a table: export it to npz, or name the feature otherwise, by `features`"
        )
    coding = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": True}
    with pq.ParquetWriter(path, schema, write_page_checksum=True, **coding) as writer:
        chunks = zip(*(dataset[each].chunks() for each in dataset.columns), strict=True)
        for chunk in Progress(chunks, unit="chunk", desc=name, leave=False):
            arrays = [numbers for values in chunk for numbers in values.reshape(len(values), -1).T]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
