"""Parquet tables: a row for each step, a column for each feature.

What jbrep exports says the checksums of its columns, and of the file of its episodes beside it.
"""

import hashlib
import io
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xxhash
from numpy.typing import NDArray

from jbrep.dataset.formats.episodes import ENDS, label
from jbrep.dataset.formats.flat import CHUNK, per_episode
from jbrep.dataset.formats.tables import PEEKED, Table, with_offsets, with_widths
from jbrep.dataset.reader import Dataset
from jbrep.envs.task import MAX_FEATURES, Task
from jbrep.errors import DamageError, InputError, first_line, refusing
from jbrep.progress import Progress
from jbrep.records.document import Document, document_from, parse_json
from jbrep.records.record import Sha256, from_plain
from jbrep.records.storage import (
    exists,
    publish,
    read_file,
    taken,
    unfinished,
    write_whole,
)

EPISODE_BYTES = 0  # besides its rows
_SETTINGS, _CHECKSUMS = b"jbrep", b"jbrep checksums"  # in a file's metadata
_MAX_COLUMNS = 1 << 14
_ROW_BYTES = 64  # of a number in a column, before compression, at most
_LIST_BYTES = 8 * MAX_FEATURES  # of a list of them


class Checksums(Document, frozen=True, kw_only=True):
    """What a table that was exported says of itself, in its metadata."""

    format = "jbrep table"
    format_version = 2

    settings: Sha256  # of the text of the data set's settings, also in the metadata
    columns: Mapping[str, str]  # XXH3 of the numbers of each
    episodes: Sha256  # of the file of episodes


def open_table(given: str) -> Table:
    """Open a Parquet file, and the one of its episodes if jbrep exported it.

    Raises:
        DamageError: it isn't what was exported.
    """
    path = Path(given)
    with reading(path), pq.ParquetFile(path) as file:
        metadata, schema = file.metadata, file.schema_arrow
        check_sizes(given, metadata, schema)
        schema = with_widths(schema, next(file.iter_batches(PEEKED), None))
        known = _checksums(path, metadata.metadata or {})
        task = _own_task(schema, metadata.metadata) if known else None
    for name, offset in zip(task.feature_names, task.offset, strict=True) if task else ():
        schema = with_offsets(schema, name, [float(offset)])
    return Table(
        given,
        label(path.stem),
        schema,
        lambda columns: _batches(path, columns, known),
        rows=metadata.num_rows,
        task=task,
        once=_once(path, known, metadata.num_rows) if known else {},
    )


def reading(path: Path) -> AbstractContextManager[None]:
    """Say of a file that it can't be read."""
    errors = (OSError, KeyError, TypeError, ValueError, pa.ArrowException)
    return refusing(f"{path} can't be read as a Parquet file", errors, told=first_line)


def check_sizes(name: str, metadata: pq.FileMetaData, schema: pa.Schema) -> None:
    """Refuse what would take much more memory than its numbers.

    Sizes of groups of rows are looked at, not those of columns: where these are damaged, pyarrow
    ends the process.
    """
    names = schema.names
    if len(names) > _MAX_COLUMNS:
        raise InputError(f"{name} has {len(names):,} columns: the limit is {_MAX_COLUMNS:,}")
    row = sum(_LIST_BYTES if pa.types.is_nested(each.type) else _ROW_BYTES for each in schema)
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        if group.total_byte_size > row * (group.num_rows + CHUNK):
            raise InputError(
                f"{name} has {group.total_byte_size:,} bytes in {group.num_rows:,} rows of "
                f"{len(names):,} columns: at most {row:,} in a row are possible"
            )


def _checksums(path: Path, metadata: Mapping[bytes, bytes]) -> Checksums | None:
    """What jbrep wrote into a table; None of any other file's."""
    if not {_SETTINGS, _CHECKSUMS} & metadata.keys():
        return None
    given = parse_json(metadata.get(_CHECKSUMS, b""), path, Checksums.format)
    known = document_from(given, path, Checksums)
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


def batches_of(path: Path, columns: list[str]) -> Iterator[pa.RecordBatch]:
    """The rows of some columns, some at a time; the checksums of pages are compared."""
    with reading(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        yield from file.iter_batches(CHUNK, columns=columns)


def _batches(path: Path, columns: list[str], known: Checksums | None) -> Iterator[pa.RecordBatch]:
    """The same; the columns' checksums are compared at the end, if jbrep exported them."""
    expected = known.columns if known else {}
    hashes = {name: xxhash.xxh3_128() for name in columns if expected}
    for batch in batches_of(path, columns):
        for name, digest in hashes.items():
            values = batch.column(name).to_numpy(zero_copy_only=False)
            digest.update(np.ascontiguousarray(values).data)
        yield batch
    for name, digest in hashes.items():
        if digest.hexdigest() != expected.get(name):
            raise _damaged(path, f"the numbers in the column {name!r}")


def _beside(path: Path) -> Path:
    """The file of episodes."""
    return path.with_stem(f"{path.stem}-episodes")


def _once(path: Path, known: Checksums, rows: int) -> dict[str, NDArray[Any]]:
    """What the file of episodes says that jbrep exports beside a table of so many rows."""
    beside = _beside(path)
    if not exists(beside):
        raise InputError(f"{beside} is missing: it belongs to {path}, and must stand beside it")
    content = read_file(beside)
    if hashlib.sha256(content).hexdigest() != known.episodes:
        raise DamageError(
            f"{beside} is damaged, or of another data set than {path}: export the data set again"
        )
    with reading(beside), pq.ParquetFile(io.BytesIO(content)) as file:
        check_sizes(str(beside), file.metadata, file.schema_arrow)
        if file.metadata.num_rows > rows:
            raise InputError(f"{beside} has more episodes than {path} has rows")
        table = file.read()
        final = np.stack(table["final_observation"].to_numpy())
        once = {name: table[name].to_numpy() for name in (*ENDS, "seed")}
        return per_episode(str(beside), {"final_observation": final, **once})


def write(dataset: Dataset, out: Path) -> str:
    """Write a file of steps, and beside it one of episodes; returns how to open them.

    The latter comes first, and may be there from an export of the same that was killed.
    """
    with unfinished(out) as partial:
        beside, episodes = _beside(out), _episodes(dataset)
        is_there = exists(beside)
        if is_there and read_file(beside) != episodes:
            raise taken(beside)
        _write_steps(dataset, partial, out.name, hashlib.sha256(episodes).hexdigest())
        write_whole(beside, episodes)
        try:
            publish(partial, out)
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
    columns = [*_numeric_columns(dataset)]
    if twice := [name for name, n in Counter(name for name, *_ in columns).items() if n > 1]:
        raise InputError(
            f"{dataset.folder} has a feature {twice[0]!r}, which is the name of another column of "
            "a table: export it to npz, or name the feature otherwise, by --features"
        )
    settings = json.dumps(dataset.manifest.settings.as_json())
    schema = pa.schema(
        [
            pa.field(name, pa.from_numpy_dtype(dtype), nullable=False, metadata={"unit": unit})
            for name, dtype, unit in columns
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
