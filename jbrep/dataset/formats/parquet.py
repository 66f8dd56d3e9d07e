"""Parquet tables: a row for each step, a column for each feature.

What jbrep exports says the checksums of its columns, and of the file of its episodes beside it.
"""

import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xxhash
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import Rows, Source, check_kind, check_names, label
from jbrep.dataset.formats.flat import CHUNK, own_names, per_episode, split
from jbrep.dataset.reader import Dataset
from jbrep.dataset.settings import Digest
from jbrep.envs.task import Feature, Task
from jbrep.errors import DamageError, InputError, first_line
from jbrep.progress import Progress
from jbrep.records.document import Document, document_in
from jbrep.records.record import from_plain
from jbrep.records.storage import (
    exists,
    publish_file,
    read_regular,
    taken,
    unfinished,
    write_whole,
)

EPISODE_BYTES = 0  # besides its rows
_SETTINGS, _CHECKSUMS = b"jbrep", b"jbrep checksums"  # in a file's metadata
_MAX_COLUMNS = 1 << 14
_MAX_BYTES = 1 << 31  # of the file of episodes
_ROW_BYTES = 64  # of a number in a column, before compression, at most
_ACTION = re.compile(r"actions?(_\d+)?")
_NOT_FEATURES = re.compile(r"__index_level_\d+__|seed")  # pandas writes the former


class Checksums(Document, frozen=True, kw_only=True):
    """What a table that was exported says of itself, in its metadata."""

    format = "jbrep table"
    format_version = 1

    settings: Digest  # of the text of the data set's settings, also in the metadata
    columns: Mapping[str, str]  # XXH3 of the numbers of each
    episodes: Digest  # of the file of episodes


def open_source(given: str) -> Source:
    """Open a Parquet file, and the one of its episodes if jbrep exported it.

    Raises:
        InputError: it can't be read, or has no columns that can be used.
        DamageError: it isn't what was exported.
    """
    name, path = given, Path(given)
    with _reading(path), pq.ParquetFile(path) as file:
        metadata, schema = file.metadata, file.schema_arrow
        _check_sizes(name, metadata, schema)
    rows, known = metadata.num_rows, _checksums(path, metadata.metadata or {})
    task = _own_task(schema, metadata.metadata) if known else None
    own = own_names(name, schema.names)
    actions = [column for column in schema.names if _ACTION.fullmatch(column)]
    if task:
        features = list(task.feature_names)
    else:
        others = {*own.values(), *actions}
        features = [n for n in schema.names if n not in others and not _NOT_FEATURES.fullmatch(n)]
    check_kind(name, "observation", np.dtype(np.float64), (len(features),))
    columns = {column: [given] for column, given in own.items()}
    columns |= {"observation": features, "action": actions}
    check_names(name, [column for column, given in columns.items() if given])
    _check_types(name, schema, columns)
    once = _once(path, known) if known else {}
    named = () if task else tuple(Feature(_word(column)) for column in features)
    return Source(
        name,
        label(path.stem),
        lambda: split(name, _chunks(path, columns, known), once),
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


def _check_sizes(name: str, metadata: pq.FileMetaData, schema: pa.Schema) -> None:
    """Refuse what would take much more memory than its numbers."""
    names = schema.names
    if len(names) > _MAX_COLUMNS:
        raise InputError(f"{name} has {len(names):,} columns: the limit is {_MAX_COLUMNS:,}")
    if twice := [each for each, count in Counter(names).items() if count > 1]:
        raise InputError(f"{name} has two columns {twice[0]!r}: rename one")
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for column in map(group.column, range(group.num_columns)):
            if column.total_uncompressed_size > _ROW_BYTES * (column.num_values + CHUNK):
                raise InputError(
                    f"{name} has {column.total_uncompressed_size:,} bytes for "
                    f"{column.num_values:,} numbers in its column {column.path_in_schema!r}"
                )


def _checksums(path: Path, metadata: Mapping[bytes, bytes]) -> Checksums | None:
    """What jbrep wrote into a table; None of any other file's."""
    if not {_SETTINGS, _CHECKSUMS} & metadata.keys():
        return None
    known = document_in(metadata.get(_CHECKSUMS, b""), path, Checksums)
    if hashlib.sha256(metadata.get(_SETTINGS, b"")).hexdigest() != known.settings:
        raise _damaged(path, "its settings")
    return known


def _damaged(path: Path, what: str) -> DamageError:
    return DamageError(
        f"{path} is damaged: {what} can't be what was exported, by their checksum; export the "
        "data set again"
    )


def _own_task(schema: pa.Schema, metadata: Mapping[bytes, bytes]) -> Task | None:
    """The task in what jbrep exported."""
    task = from_plain(json.loads(metadata[_SETTINGS])["environment"], Task)
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


def _chunks(path: Path, columns: dict[str, list[str]], known: Checksums | None) -> Iterator[Rows]:
    """The rows, some at a time; the columns' checksums are compared at the end."""
    wanted = [given for group in columns.values() for given in group]
    hashes = {name: xxhash.xxh3_128() for name in wanted}
    with _reading(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        for batch in file.iter_batches(CHUNK, columns=wanted):
            _check_full(path, batch)
            arrays = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in wanted}
            for name, values in arrays.items():
                hashes[name].update(np.ascontiguousarray(values).data)
            yield {name: _array(name, arrays, given) for name, given in columns.items()}
    expected = known.columns if known else {}
    for name in expected and wanted:
        if hashes[name].hexdigest() != expected.get(name):
            raise _damaged(path, f"the numbers in the column {name!r}")


def _check_full(path: Path, batch: pa.RecordBatch) -> None:
    for column, values in zip(batch.schema.names, batch.columns, strict=True):
        if values.null_count:
            raise InputError(
                f"{path} has empty cells in the column {column!r}: fill them, or leave the "
                "episode out"
            )


def _array(name: str, arrays: Mapping[str, NDArray[Any]], columns: list[str]) -> NDArray[Any]:
    given = [arrays[column] for column in columns]
    return np.stack(given, axis=1) if name in ("observation", "action") else given[0]


def _beside(path: Path) -> Path:
    """The file of episodes."""
    return path.with_stem(f"{path.stem}-episodes")


def _once(path: Path, known: Checksums) -> dict[str, NDArray[Any]]:
    """What the file of episodes says that jbrep exports beside a table."""
    beside = _beside(path)
    if not exists(beside):
        raise InputError(f"{beside} is missing: it belongs to {path}, and must stand beside it")
    content = read_regular(beside, _MAX_BYTES)
    if hashlib.sha256(content).hexdigest() != known.episodes:
        raise DamageError(
            f"{beside} is damaged, or of another data set than {path}: export the data set again"
        )
    with _reading(beside):
        table = pq.read_table(io.BytesIO(content))
        final = np.stack(table["final_observation"].to_numpy())
        once = {name: table[name].to_numpy() for name in ("terminated", "seed")}
        return per_episode(str(beside), {"final_observation": final, **once})


def _word(column: str) -> str:
    """The name of a column as a feature's."""
    word = re.sub(r"[^A-Za-z0-9_.-]", "_", column)
    return word if word[:1].isalpha() else f"obs_{word}"


def write(dataset: Dataset, out: Path) -> str:
    """Write a file of steps, and beside it one of episodes; returns how to open them.

    The latter comes first, and may be there from an export of the same that was killed.
    """
    with unfinished(out) as partial:
        beside, episodes = _beside(out), _episodes(dataset)
        is_there = exists(beside)
        if is_there and read_regular(beside, _MAX_BYTES) != episodes:
            raise taken(beside)
        _write_steps(dataset, partial, out.name, hashlib.sha256(episodes).hexdigest())
        write_whole(beside, episodes)
        try:
            publish_file(partial, out)
        except BaseException:
            if not is_there:
                beside.unlink()
            raise
    return f"pandas.read_parquet({str(out)!r}), and {beside.name} for the episodes"


def _episodes(dataset: Dataset) -> bytes:
    """The file of episodes."""
    content = io.BytesIO()
    columns = {name: list(values) for name, values in dataset.episodes.items()}
    pq.write_table(pa.table(columns), content, write_page_checksum=True)
    return content.getvalue()


def _write_steps(dataset: Dataset, path: Path, name: str, episodes: str) -> None:
    """The settings and checksums are in the file's metadata, the units in the columns'."""
    settings = json.dumps(dataset.manifest.settings.as_json())
    schema = pa.schema(
        [
            pa.field(name, pa.from_numpy_dtype(dtype), nullable=False, metadata={"unit": unit})
            for name, dtype, unit in _numeric_columns(dataset)
        ],
        metadata={_SETTINGS: settings},
    )
    hashes = [xxhash.xxh3_128() for _ in schema.names]
    coding = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": True}
    with pq.ParquetWriter(path, schema, write_page_checksum=True, **coding) as writer:
        chunks = zip(*(dataset[name].chunks() for name in dataset.columns), strict=True)
        for chunk in Progress(chunks, unit="chunk", desc=name, leave=False):
            arrays = [numbers for values in chunk for numbers in values.reshape(len(values), -1).T]
            for digest, numbers in zip(hashes, arrays, strict=True):
                digest.update(np.ascontiguousarray(numbers).data)
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
        known = Checksums(
            settings=hashlib.sha256(settings.encode()).hexdigest(),
            columns={n: each.hexdigest() for n, each in zip(schema.names, hashes, strict=True)},
            episodes=episodes,
        )
        writer.add_key_value_metadata({_CHECKSUMS: known.text()})


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
