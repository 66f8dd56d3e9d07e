"""A figure with the table that it is drawn from, and the files that both become."""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from jbrep.dataset.storage import make_folder, write_whole
from jbrep.figures.style import PAPER
from jbrep.tables import csv_text

_UNDATED: dict[str, dict[str, Any]] = {  # the same bytes each time
    "pdf": {"CreationDate": None},
    "png": {"Software": None},
    "svg": {"Date": None},
}


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure to be drawn.

    Args:
        name: of its files.
        title: a few words.
        caption: what is to be seen.
        columns: of the table that it is drawn from.
        rows: of that table.
        draw: makes the figure, in the style that holds at the time.
    """

    name: str
    title: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    draw: Callable[[], Figure]


def write(plots: Iterable[Plot], folder: Path) -> list[Path]:
    """Write each figure as PDF and PNG, and its table as CSV.

    Returns:
        The pictures.

    Raises:
        InputError: they can't be written.
    """
    make_folder(folder)
    pictures = []
    for plot in plots:
        for kind in ("pdf", "png"):
            write_whole(folder / f"{plot.name}.{kind}", picture(plot, kind, PAPER))
        write_whole(folder / f"{plot.name}.csv", csv_text(plot.columns, plot.rows).encode())
        pictures.append(folder / f"{plot.name}.png")
    return pictures


def picture(plot: Plot, kind: str, style: Any) -> bytes:
    """A figure as pdf, png or svg in a style."""
    content = io.BytesIO()
    with mpl.rc_context(style):
        plot.draw().savefig(content, format=kind, metadata=_UNDATED[kind])
    return content.getvalue()
