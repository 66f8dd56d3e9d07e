"""Bags of ROS as rosbags reads them, within limits: a stranger's bag can be made to take anything.

What is compressed is unpacked in memory or to a temporary file, where kilobytes can become
gigabytes. A database can compute what is read from it, and a type can have any number of parts.
"""

import os
import sqlite3
from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

from lz4.frame import LZ4FrameDecompressor
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import reader as ros2
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_typestore

from jbrep.envs.task import MAX_FEATURES
from jbrep.errors import InputError, first_line, refusing

_MOST_AT_ONCE = 1 << 28  # bytes that a chunk or a message unpacks to
_MOST_TIMES = 1000  # the size of a file may be what all of it unpacks to, besides the above
_OF_ADDRESSES = "%?#"  # what SQLite takes for other characters, as rosbags gives it a path
_COMPUTED = """
SELECT type || ' ' || name FROM pragma_table_list WHERE type != 'table' UNION ALL
SELECT 'computed column ' || c.name FROM pragma_table_list AS t, pragma_table_xinfo(t.name) AS c
WHERE t.type = 'table' AND c.hidden
"""  # which takes what time and memory it likes
_zstd = ros2.zstd  # type: ignore[attr-defined] # of the standard library or its backport


@contextmanager
def opened(path: Path) -> Iterator[AnyReader]:
    """A reader of a bag; types that the bag doesn't define are those of ROS 2."""
    if path.is_dir() and path.suffix == ".bag":
        raise InputError(f"{path} is a folder, and files of ROS 1 end in .bag: rename it")
    refused = f"{path} can't be read as a bag"
    large = refusing(refused, (_TooLargeError,), told=first_line)
    with refusing(refused), large:  # and whatever damaged bags raise
        store = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([path], default_typestore=store) as reader:
            for name, (_, fields) in reader.typestore.fielddefs.items():
                if sum(map(_parts, fields)) > MAX_FEATURES:
                    has = f"{path} has messages {name} of more than {MAX_FEATURES:,} parts"
                    raise InputError(f"{has}: record it without them")
            yield reader


def _parts(field: tuple[str, Any]) -> int:
    """How many parts of a message rosbags makes code for, of a field: arrays of numbers are one."""
    kind, of = field[1]
    if kind != Nodetype.ARRAY:
        return 1
    (kind, of), count = of
    return int(count) if kind == Nodetype.NAME or of[0] == "string" else 1


class _TooLargeError(Exception):
    """Something unpacks to more than is possible."""


def _unpacked(decompressor: Callable[[], Any], data: bytes) -> bytes:
    """What was compressed, in one piece or several; data that end too early raise EOFError."""
    pieces, left = list[bytes](), _MOST_AT_ONCE
    while data:
        piece = decompressor()
        pieces.append(piece.decompress(data, left + 1))
        left -= len(pieces[-1])
        if left < 0:
            raise _TooLargeError(f"a chunk or message unpacks to over {_MOST_AT_ONCE:,} bytes")
        if not piece.eof:
            raise EOFError("compressed data that end too early")
        data = piece.unused_data
    return b"".join(pieces)


def _most(size: int) -> int:
    """How many bytes a file of so many may unpack to."""
    return _MOST_TIMES * size + _MOST_AT_ONCE


class _ZstdFile(_zstd.ZstdFile):  # type: ignore[name-defined]
    """A compressed file that is read so far only."""

    def __init__(self, file: BinaryIO, mode: str) -> None:
        super().__init__(file, mode)
        self._left = _most(os.fstat(file.fileno()).st_size)

    def read(self, size: int | None = -1) -> bytes:
        some: bytes = super().read(size)
        self._left -= len(some)
        if self._left < 0:
            raise _TooLargeError(f"it unpacks to over {_MOST_TIMES:,} times its size")
        return some


class _Database(Sqlite3Reader):
    """A database that has nothing but plain tables."""

    def open(self) -> None:
        path = str(self.path)
        if any(each in path for each in _OF_ADDRESSES):
            raise InputError(f"{path} can't be opened with any of {_OF_ADDRESSES} in it: rename it")
        with closing(sqlite3.connect(f"file:{path}?immutable=1", uri=True)) as database:
            if computed := database.execute(_COMPUTED).fetchone():
                raise InputError(f"{path} has the {computed[0]}: a bag has plain tables only")
        super().open()


class _Mcap(mcap.McapReader):
    """A file whose chunks can all be unpacked at once, as they are where their times overlap."""

    def open(self) -> None:
        super().open()
        total = sum(each.uncompressed_size for each in self.chunks)
        if total > _most(Path(str(self.path)).stat().st_size):
            self.close()
            raise _TooLargeError(f"it unpacks to over {_MOST_TIMES:,} times its size")


def _within(decompressor: Callable[[], Any]) -> Callable[..., bytes]:
    """What unpacks data, as rosbags calls it."""
    return lambda data, *_: _unpacked(decompressor, data)


# rosbags has no other door for these: they hold wherever else the process reads bags by it
ros2.Reader.STORAGE_PLUGINS = {**ros2.Reader.STORAGE_PLUGINS, ".db3": _Database, ".mcap": _Mcap}
ros2.DirectoryReader.STORAGE_PLUGINS = {"sqlite3": _Database, "mcap": _Mcap}
ros1.decompressors.update(lz4=_within(LZ4FrameDecompressor), bz2=_within(BZ2Decompressor))
mcap.DECOMPRESSORS.update(lz4=_within(LZ4FrameDecompressor), zstd=_within(_zstd.ZstdDecompressor))
ros2.zstd = SimpleNamespace(  # type: ignore[assignment, attr-defined]
    open=_ZstdFile, decompress=_within(_zstd.ZstdDecompressor)
)
