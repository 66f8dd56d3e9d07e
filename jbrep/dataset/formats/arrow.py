"""Frames in Python, as tables."""

from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa

from jbrep.dataset.formats.episodes import label
from jbrep.dataset.formats.flat import CHUNK
from jbrep.dataset.formats.tables import PEEKED, Table, with_widths
from jbrep.errors import refusing


def table_of(frame: Any, name: str) -> Table:
    """A frame of pandas or polars, or whatever else Arrow takes."""
    with refusing(f"{name} isn't a table", (TypeError, ValueError, pa.ArrowException)):
        columns = dict(frame) if isinstance(frame, Mapping) else frame
        table = pa.table(columns).combine_chunks()

    def batches(names: list[str]) -> Iterator[pa.RecordBatch]:
        yield from table.select(names).to_batches(CHUNK)

    schema = with_widths(table.schema, next(iter(table.slice(0, PEEKED).to_batches()), None))
    return Table(name, label(name), schema, batches, rows=table.num_rows)
