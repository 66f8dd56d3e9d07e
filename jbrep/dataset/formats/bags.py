"""Bags of ROS 1 and ROS 2, the latter as MCAP or SQLite: a column for each number of a topic.

Each message is a row that has the numbers of its topic only, at the time when it was recorded.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from jbrep.dataset.formats.episodes import label
from jbrep.dataset.formats.flat import CHUNK
from jbrep.dataset.formats.tables import Table
from jbrep.dataset.layout import Layout
from jbrep.envs.task import MAX_FEATURES
from jbrep.errors import InputError, kind_and_line

_TIME = "time"
_DEEPEST = 8  # messages in messages
_PEEKED = 200  # messages of a topic by which its numbers are known


def open_table(given: str) -> Table:
    """Open a .bag of ROS 1, an .mcap or .db3, or the folder of a bag of ROS 2.

    Raises:
        InputError: it can't be read.
    """
    path, columns, unknown = Path(given), list[str](), list[str]()
    with _opened(path) as reader:
        for topic in sorted(reader.topics):
            messages = islice(_messages(reader, {topic}), _PEEKED)
            known = dict.fromkeys(name for _, _, numbers in messages for name in numbers)
            columns += known
            if not known:
                unknown.append(topic)
    schema = pa.schema([(_TIME, pa.timestamp("ns")), *((name, pa.float64()) for name in columns)])
    return Table(
        given,
        label(path.stem),
        schema,
        lambda names: _batches(path, schema, names),
        layout=Layout(time=_TIME),
        is_sparse=True,
        notes=(f"no numbers known in {', '.join(unknown)}",) if unknown else (),
    )


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """A reader of a bag; types that the bag doesn't define are those of ROS 2."""
    try:
        store = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([path], default_typestore=store) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:  # whatever damaged bags raise
        raise InputError(f"{path} can't be read as a bag: {kind_and_line(error)}") from None


def _messages(reader: AnyReader, topics: set[str]) -> Iterator[tuple[int, str, dict[str, float]]]:
    """Time [ns], topic and numbers of each message, if any, in the order of times."""
    connections = [each for each in reader.connections if each.topic in topics]
    for connection, time, raw in reader.messages(connections) if connections else ():
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except KeyError:  # a type that nobody defines
            message = None
        yield time, connection.topic, dict(_numbers(message, connection.topic, 0))


def _numbers(value: Any, name: str, depth: int) -> Iterator[tuple[str, float]]:
    """The numbers in a message, by the path to them; those of joints by the joints' names."""
    if isinstance(value, bool | int | float | np.number | np.bool_):
        yield name, float(value)
    elif isinstance(value, np.ndarray | list | dict):
        if len(value) <= MAX_FEATURES and depth < _DEEPEST:
            for key, each in value.items() if isinstance(value, dict) else enumerate(value):
                yield from _numbers(each, f"{name}.{key}", depth + 1)
    elif depth < _DEEPEST:
        for field in getattr(value, "__dataclass_fields__", ()):
            part, names = getattr(value, field), getattr(value, "name", None)
            if isinstance(names, list) and isinstance(part, np.ndarray) and len(names) == len(part):
                part = dict(zip(names, part, strict=True))
            if not field.startswith("__"):
                yield from _numbers(part, f"{name}.{field}", depth + 1)


def _batches(path: Path, schema: pa.Schema, names: list[str]) -> Iterator[pa.RecordBatch]:
    """The messages with some of the numbers, some at a time."""
    known = {*schema.names}
    with _opened(path) as reader:
        topics = {t for t in reader.topics if any(name.startswith(f"{t}.") for name in names)}
        messages = (each for each in _messages(reader, topics) if each[2])
        while some := list(islice(messages, CHUNK)):
            for time, topic, numbers in some:
                if new := numbers.keys() - known:
                    raise InputError(
                        f"{path}, {topic} at {time / 1e9:.3f} s: {min(new)} is in none of its "
                        f"first {_PEEKED} messages"
                    )
            columns = [
                pa.array([time for time, _, _ in some], pa.timestamp("ns"))
                if name == _TIME
                else pa.array([numbers.get(name) for _, _, numbers in some], pa.float64())
                for name in names
            ]
            yield pa.RecordBatch.from_arrays(columns, names=names)
