"""A figure with the table that it is drawn from, and the files of both."""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from jbrep.progress import Progress
from jbrep.records.lock import exclusive
from jbrep.records.storage import make_folder, write_whole
from jbrep.records.tables import csv_text
from jbrep.report.figures.style import PAPER

_UNDATED: dict[str, dict[str, Any]] = {  # the same bytes each time
    "pdf": {"CreationDate": None},
    "png": {"Software": None},
    "svg": {"Date": None},
}


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure to be drawn."""

    name: str  # of its files
    title: str  # a few words
    caption: str  # what the figure shows
    columns: Sequence[str]  # of the table that it is drawn from
    rows: Sequence[Sequence[Any]]  # of that table
    draw: Callable[[], Figure]  # makes the figure in the style in use

    @cached_property
    def on_paper(self) -> "Drawing":
        """The figure in the style of a paper."""
        return Drawing(self.draw, PAPER)


class Drawing:
    """A figure drawn and laid out once in a style, for any number of files."""

    def __init__(self, draw: Callable[[], Figure], style: Any):
        with mpl.rc_context(style):
            self._figure = draw()
            self._figure.draw_without_rendering()
        # a layout engine, even one that does nothing, has savefig draw everything twice
        self._style = {**style, "figure.constrained_layout.use": False}
        with mpl.rc_context(self._style):
            self._figure.set_layout_engine(None)

    @property
    def width(self) -> float:
        """Width in inches."""
        return float(self._figure.get_figwidth())

    def picture(self, kind: str) -> bytes:
        """The figure as pdf, png or svg."""
        content = io.BytesIO()
        with mpl.rc_context(self._style):
            self._figure.savefig(content, format=kind, metadata=_UNDATED[kind])
        return content.getvalue()


def write(plots: Iterable[Plot], folder: Path) -> list[Path]:
    """Write each figure as PDF and PNG, and its table as CSV.

    Returns:
        The paths of the PNG files.
    """
    make_folder(folder)
    pictures = []
    with exclusive(folder):
        for plot in Progress(list(plots), unit="figure", delay=1, leave=False):
            for kind in ("pdf", "png"):
                write_whole(folder / f"{plot.name}.{kind}", plot.on_paper.picture(kind))
            write_whole(folder / f"{plot.name}.csv", csv_text(plot.columns, plot.rows).encode())
            pictures.append(folder / f"{plot.name}.png")
    return pictures
