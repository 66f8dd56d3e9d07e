"""Bags of ROS 1 and ROS 2, the latter as MCAP or SQLite: a column for each number of a topic.

Each message is a row that has the numbers of its topic only, at the time when it was recorded.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from rosbags.highlevel import AnyReader

from jbrep.dataset.formats.bag_reader import opened
from jbrep.dataset.formats.episodes import digits_lost, label
from jbrep.dataset.formats.flat import CHUNK
from jbrep.dataset.formats.tables import Table
from jbrep.dataset.layout import Layout
from jbrep.envs.task import MAX_FEATURES
from jbrep.records.record import MOST_WHOLE

_TIME = "time"
_DEEPEST = 8  # messages in messages
_PEEKED = 200  # messages of a topic by which its numbers are known


class _Message(NamedTuple):
    """The numbers of a message, if any."""

    time: int  # when it was recorded [ns]
    topic: str
    numbers: dict[str, Any]  # by the path to them: bool, int or float

    @property
    def place(self) -> str:
        """Where it stands, for messages."""
        return f"{self.topic} at {self.time / 1e9:.3f} s"


def open_table(given: str) -> Table:
    """Open a .bag of ROS 1, an .mcap or .db3, or the folder of a bag of ROS 2."""
    path, columns, unknown, late = Path(given), list[str](), list[str](), dict[str, str]()
    with opened(path) as reader:
        for topic in sorted(reader.topics):
            messages = islice(_messages(reader, {topic}), _PEEKED)
            known = dict.fromkeys(name for each in messages for name in each.numbers)
            columns += known
            if not known:
                unknown.append(topic)
    schema = pa.schema([(_TIME, pa.timestamp("ns")), *((name, pa.float64()) for name in columns)])
    return Table(
        given,
        label(path.stem),
        schema,
        lambda names: _batches(path, schema, names, late),
        late=late,
        layout=Layout(time=_TIME),
        is_sparse=True,
        notes=(f"no numbers known in {', '.join(unknown)}",) if unknown else (),
    )


def _messages(reader: AnyReader, topics: set[str]) -> Iterator[_Message]:
    """The messages of some topics, in the order of times."""
    connections = [each for each in reader.connections if each.topic in topics]
    for connection, time, raw in reader.messages(connections) if connections else ():
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except KeyError:  # a type that nobody defines
            message = None
        yield _Message(time, connection.topic, dict(_numbers(message, connection.topic, 0)))


def _numbers(value: Any, name: str, depth: int) -> Iterator[tuple[str, Any]]:
    """The numbers in a message, by the path to them; those of joints by the joints' names."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool | int | float):
        yield name, value
    elif isinstance(value, np.ndarray | list | dict):
        if len(value) <= MAX_FEATURES and depth < _DEEPEST:
            for key, each in value.items() if isinstance(value, dict) else enumerate(value):
                yield from _numbers(each, f"{name}.{key}", depth + 1)
    elif depth < _DEEPEST:
        for field in getattr(value, "__dataclass_fields__", ()):
            part, names = getattr(value, field), getattr(value, "name", ())
            if isinstance(part, np.ndarray) and _tell_apart(names, len(part)):
                part = dict(zip(names, part, strict=True))
            if not field.startswith("__"):
                yield from _numbers(part, f"{name}.{field}", depth + 1)


def _tell_apart(names: Any, count: int) -> bool:
    """Whether they are the different names of so many numbers, none of them empty."""
    if not isinstance(names, list) or not all(isinstance(each, str) and each for each in names):
        return False
    return len({*names}) == len(names) == count


def _batches(
    path: Path, schema: pa.Schema, names: list[str], late: dict[str, str]
) -> Iterator[pa.RecordBatch]:
    """The messages with some of the numbers, some at a time; what is late is added, see `Table`."""
    known = {*schema.names}
    with opened(path) as reader:
        topics = {t for t in reader.topics if any(name.startswith(f"{t}.") for name in names)}
        messages = (each for each in _messages(reader, topics) if each.numbers)
        while some := list(islice(messages, CHUNK)):
            for message in some:
                for name in message.numbers.keys() - known - late.keys():
                    place = f"{path}, {message.place}"
                    late[name] = f"{place}: {name} is in none of its first {_PEEKED} messages"
            columns = [
                pa.array([each.time for each in some], pa.timestamp("ns"))
                if name == _TIME
                else pa.array([_single(path, each, name) for each in some], pa.float64())
                for name in names
            ]
            yield pa.RecordBatch.from_arrays(columns, names=names)


def _single(path: Path, message: _Message, name: str) -> float | None:
    """A number of a message, if it has it."""
    number = message.numbers.get(name)
    if isinstance(number, int) and abs(number) > MOST_WHOLE:
        raise digits_lost(f"{path}, {message.place}: {name}", number)
    return None if number is None else float(number)
