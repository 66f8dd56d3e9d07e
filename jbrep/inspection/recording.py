"""A Rerun recording, built up in memory column by column and written whole."""

import hashlib
from collections.abc import Iterable, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from jbrep.errors import InputError
from jbrep.records.storage import exclusive, exists, make_folder, write_whole

PROVENANCE = "provenance"
SUFFIX = ".rrd"
_APPLICATION = "jbrep"
_MAGIC = b"RRF"  # the first bytes of a Rerun recording of any version

Colour = tuple[int, int, int]
# Okabe and Ito's colours, safe for colour blindness; grey for black, as viewers may be dark
SKY, ORANGE, GREEN, PURPLE = (86, 180, 233), (230, 159, 0), (0, 158, 115), (204, 121, 167)
VERMILION, YELLOW, BLUE, GREY = (213, 94, 0), (240, 228, 66), (0, 114, 178), (160, 160, 160)
_COLOURS: tuple[Colour, ...] = (SKY, ORANGE, GREEN, PURPLE, VERMILION, YELLOW, BLUE, GREY)


def pieces(path: NDArray[np.float64]) -> NDArray[np.float32]:
    """The line from each point of a path (n, k) to the next, (n, 2, k); the first has no length."""
    return np.stack((np.concatenate((path[:1], path[:-1])), path), axis=1).astype(np.float32)


class Recording:
    """A recording in memory, until it is written, with a title and Markdown beside it.

    Its id is a hash of that text and of numbers: the same content has the same id.
    """

    def __init__(self, name: str, about: str, *numbers: NDArray[Any]):
        digest = hashlib.sha256(about.encode())
        for array in numbers:
            digest.update(array.tobytes())
        self._stream = rr.RecordingStream(
            _APPLICATION, recording_id=digest.hexdigest()[:32], send_properties=False
        )
        self._memory = self._stream.memory_recording()
        self._stream.send_recording_name(name)
        self.send_text(PROVENANCE, about)

    def send(self, path: str, *parts: rr.AsComponents) -> None:
        """Send components that hold at all times."""
        self._stream.log(path, *parts, static=True, strict=True)

    def send_text(self, path: str, markdown: str) -> None:
        """Send a page of text."""
        self.send(path, rr.TextDocument(markdown, media_type="text/markdown"))

    def send_columns(
        self, path: str, times: Sequence[rr.TimeColumn], *columns: Iterable[rr.ComponentColumn]
    ) -> None:
        """Send components that change, with a row for each time."""
        flat = [column for each in columns for column in each]
        self._stream.send_columns(path, times, flat, strict=True)

    def send_moving(
        self,
        path: str,
        times: Sequence[rr.TimeColumn],
        shape: Any,
        colour: Colour,
        radius: float,
        **columns: Any,
    ) -> None:
        """Send a shape, Rerun's class of it, whose columns change but not colour and radius."""
        self.send(path, shape.from_fields(colors=[colour], radii=[radius]))
        self.send_columns(path, times, shape.columns(**columns))

    def send_series(
        self,
        path: str,
        times: Sequence[rr.TimeColumn],
        values: NDArray[Any],
        names: Sequence[str],
        colours: Sequence[Colour] | None = None,
        width: float = 2.0,
    ) -> None:
        """Send the lines (rows, lines) of a plot, whose names have units; width is in points."""
        lines = len(names)
        colours = colours or [*islice(cycle(_COLOURS), lines)]
        style = rr.SeriesLines(names=names, colors=colours, widths=[width] * lines)
        self.send(path, style)
        self.send_columns(path, times, rr.Scalars.columns(scalars=values))

    def write(self, path: Path, blueprint: rrb.Blueprint) -> None:
        """Write the recording with its layout, whole or not at all."""
        make_folder(path.parent)
        self._stream.send_blueprint(blueprint)
        with exclusive(path, beside=True):
            check_out(path)
            write_whole(path, self._memory.drain_as_bytes())


def _is_recording(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def check_out(path: Path) -> None:
    """Make sure that a recording can be there, and only an earlier one would be overwritten."""
    if not exists(path):
        if path.suffix != SUFFIX:
            name = path.with_suffix(SUFFIX)
            raise InputError(f"a recording is a file such as {name}, not {path}")
    elif not path.is_file() or not _is_recording(path):
        raise InputError(f"{path} exists and is not a Rerun recording: choose another `out`")
