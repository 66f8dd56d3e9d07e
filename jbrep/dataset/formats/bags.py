"""Bags of ROS 1 and ROS 2, the latter as MCAP or SQLite: a column for each number of a topic.

Each message is a row that has the numbers of its topic only, at the time when it was recorded.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_typestore

from jbrep.dataset.formats.frame import CHUNK, Frame, check_plain, label_of
from jbrep.dataset.layout import Layout
from jbrep.envs.task import MAX_FEATURES
from jbrep.errors import InputError, refusing

_TIME = "time"
_DEEPEST = 8  # messages in messages
_PEEKED = 200  # messages of a topic by which its numbers are known
_OF_ADDRESSES = "%?#"  # rosbags gives SQLite an address, in which these stand for something else
_Numbers = dict[str, Any]  # of a message, by the path to them; and when it was recorded [ns]


def read(given: str) -> Frame:
    """Read a .bag of ROS 1, an .mcap or .db3, or the folder of a bag of ROS 2."""
    path, columns, unknown, late = Path(given), dict[str, None](), list[str](), dict[str, str]()
    with _opened(path) as reader:
        for topic in sorted(reader.topics):
            names = (name for each in _first(reader, topic) for name in each if name != _TIME)
            known = dict.fromkeys(names)
            columns |= known
            unknown += [] if known else [topic]

    def batches(names: list[str]) -> Iterator[pa.RecordBatch]:
        with _opened(path) as reader:
            topics = {t for t in reader.topics if any(name.startswith(f"{t}.") for name in names)}
            messages = (each for each in _messages(reader, topics) if len(each) > 1)
            while some := [*islice(messages, CHUNK)]:
                for each in some:
                    for name in each.keys() - columns - late.keys() - {_TIME}:
                        at = f"{path}, at {each[_TIME] / 1e9:.3f} s"
                        late[name] = f"{at}: {name} is in none of its first {_PEEKED} messages"
                arrays = [pa.array([each.get(name) for each in some]) for name in names]
                yield pa.RecordBatch.from_arrays(arrays, names=names)

    kinds = {_TIME: pa.timestamp("ns"), **dict.fromkeys(columns, pa.float64())}
    return Frame(
        name=given,
        label=label_of(path.stem),
        schema=pa.schema(kinds.items()),
        batches=batches,
        late=late,
        layout=Layout(time=_TIME),
        is_sparse=True,
        place="message {}".format,
        notes=(f"no numbers known in {', '.join(unknown)}",) if unknown else (),
    )


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """A reader of a bag; types that the bag doesn't define are those of ROS 2."""
    if path.is_dir() and path.suffix == ".bag":
        raise InputError(f"{path} is a folder, and files of ROS 1 end in .bag: rename it")
    check_plain(path)
    for each in [*path.rglob("*")] or [path]:
        address = str(each if ".db3" in each.name else each.relative_to(path))
        if any(letter in address for letter in _OF_ADDRESSES):
            raise InputError(f"{each} can't be opened with any of {_OF_ADDRESSES} in it: rename it")
    types = get_typestore(Stores.ROS2_HUMBLE)
    with (
        refusing(f"{path} can't be read as a bag"),  # whatever damaged bags raise
        AnyReader([path], default_typestore=types) as reader,
    ):
        yield reader


def _first(reader: AnyReader, topic: str) -> Iterator[_Numbers]:
    """The numbers of a topic's first messages."""
    connections = [each for each in reader.connections if each.topic == topic]
    for message in islice(reader.messages(connections), _PEEKED):
        yield _read(reader, *message)


def _messages(reader: AnyReader, topics: set[str]) -> Iterator[_Numbers]:
    """The numbers of messages of some topics, by their times.

    Where the recorder's clock was set back, they are those before that, then those after it.
    """
    connections = [each for each in reader.connections if each.topic in topics]
    clocks = _clocks(reader, topics)
    for clock in range(1 + max(map(max, filter(None, clocks.values())), default=-1)):
        own = {topic: iter(each) for topic, each in clocks.items()}
        for message in reader.messages(connections):
            if next(own[message[0].topic]) == clock:
                yield _read(reader, *message)


def _read(reader: AnyReader, connection: Any, time: int, raw: bytes) -> _Numbers:
    try:
        message = reader.deserialize(raw, connection.msgtype)
    except KeyError:  # a type that nobody defines
        message = None
    return {_TIME: time, **dict(_numbers(message, connection.topic, 0))}


def _clocks(reader: AnyReader, topics: set[str]) -> dict[str, list[int]]:
    """Of each topic's messages, by their times: how often the clock was set back before each.

    A topic's own messages are written in order, so that one with an earlier time has another clock;
    those of several topics may be a little out of order.
    """
    latest, count = dict[str, int](), 0
    found: dict[str, list[tuple[int, int]]] = {topic: [] for topic in topics}
    for topic, time in _recorded(reader):
        if time < latest.get(topic, time):
            latest, count = {}, count + 1
        latest[topic] = time
        if topic in topics:
            found[topic].append((time, count))
    return {
        topic: [clock for _, clock in sorted(some, key=itemgetter(0))]
        for topic, some in found.items()
    }


def _recorded(reader: AnyReader) -> Iterator[tuple[str, int]]:
    """Topic and time [ns] of each message, as they were written, whatever the clock said."""
    for each in reader.readers:
        if isinstance(each, Reader1):
            topics = {connection.id: connection.topic for connection in each.connections}
            index = [
                (*entry[1:], entry[0], topics[k])
                for k, some in each.indexes.items()
                for entry in some
            ]
            yield from ((topic, time) for *_, time, topic in sorted(index))
            continue
        for storage in getattr(each.storage, "storages", [each.storage]):
            if isinstance(storage, McapReader):
                scan = storage.messages_scan(storage.connections)
                yield from ((connection.topic, time) for connection, time, _ in scan)
                continue
            with closing(sqlite3.connect(storage.path)) as database:
                yield from database.execute(
                    "SELECT name, timestamp FROM messages JOIN topics ON topics.id = topic_id "
                    "ORDER BY messages.id"
                )


def _numbers(value: Any, name: str, depth: int) -> Iterator[tuple[str, Any]]:
    """The numbers in a message, by the path to them; those of joints by the joints' names."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool | int | float):
        yield name, value
    elif depth == _DEEPEST:
        return
    elif isinstance(value, np.ndarray | list | dict):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        for key, each in pairs if len(value) <= MAX_FEATURES else ():
            yield from _numbers(each, f"{name}.{key}", depth + 1)
    else:
        for field in getattr(value, "__dataclass_fields__", ()):
            part, names = getattr(value, field), getattr(value, "name", ())
            if isinstance(part, np.ndarray) and _tell_apart(names, len(part)):
                part = dict(zip(names, part, strict=True))
            if not field.startswith("__"):
                yield from _numbers(part, f"{name}.{field}", depth + 1)


def _tell_apart(names: Any, count: int) -> bool:
    """Whether they are the different names of so many numbers, none of them empty."""
    are_words = isinstance(names, list) and all(isinstance(each, str) and each for each in names)
    return are_words and len({*names}) == len(names) == count
