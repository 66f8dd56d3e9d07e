"""Encoders' diagnostics in a few named numbers, and the table of many encoders: diagnostics.csv."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jbrep.evaluate.evaluation import Diagnostics, Score, Scores
from jbrep.records.tables import Columns, csv_text, finite, read_csv

DIAGNOSTICS = "diagnostics.csv"  # of a study, or beside encoders
Values = Mapping[str, float | None]  # by the names of SCALARS; None where it isn't known


class Scalar(NamedTuple):
    """A named number of an encoder's diagnostics: a column of the table.

    Attributes:
        words: what it is, in a few words.
        read: finds it among all that is known of the encoder.
        better: 1 if higher is better, -1 if lower is.
    """

    words: str
    read: Callable[[Diagnostics], Score | None]
    better: int = 1


def _ahead(steps: int, what: str) -> Callable[[Diagnostics], Score | None]:
    """A score of the prediction so many steps ahead; None where episodes are too short for it."""

    def read(known: Diagnostics) -> Score | None:
        prediction = known.prediction.get(str(steps))
        return getattr(prediction, what) if prediction else None

    return read


def _loses(what: str) -> Callable[[Diagnostics], Score | None]:
    """A score of the reconstruction; None of an encoder that doesn't decode."""
    return lambda known: getattr(known.reconstruction, what) if known.reconstruction else None


def _mean(scores: Scores) -> Score:
    known = [score.value for score in scores.values() if score.value is not None]
    return Score(sum(known) / len(known) if known else None, None, None)


SCALARS = {
    "forward": Scalar("R² of the features' change over 10 steps", _ahead(10, "mean")),
    "rewarded": Scalar(
        "R² of the change over 10 steps of what the reward depends on", _ahead(10, "rewarded")
    ),
    "reward": Scalar("R² of the mean reward of 10 steps", _ahead(10, "reward")),
    "value": Scalar("R² of a good policy's return to go", lambda e: e.value),
    "action": Scalar(
        "R² of a good policy's action", lambda e: e.action.nonlinear if e.action else None
    ),
    "forward_1": Scalar("R² of the features' change over 1 step", _ahead(1, "mean")),
    "forward_5": Scalar("the same over 5 steps", _ahead(5, "mean")),
    "forward_20": Scalar("the same over 20 steps", _ahead(20, "mean")),
    "probes": Scalar("mean R² of linear probes of the state", lambda e: _mean(e.probes)),
    "nonlinear_probes": Scalar(
        "mean R² of nonlinear probes of the state", lambda e: _mean(e.nonlinear_probes)
    ),
    "next": Scalar("R² of the next latent, linear", lambda e: e.dynamics.linear),
    "knn": Scalar(
        "how unlike states of near latents are (KNN-MSE)", lambda e: e.neighbours.mse, -1
    ),
    "gtc": Scalar("how directly units show the state (GTC)", lambda e: e.correlation.mean),
    "error": Scalar("squared error of the reconstruction", _loses("mse"), -1),
    "times_pca": Scalar("that error over PCA's", _loses("ratio_to_pca"), -1),
}


def headline(known: Diagnostics) -> Values:
    """The named numbers of an encoder."""
    found = {name: scalar.read(known) for name, scalar in SCALARS.items()}
    return {name: score.value if score else None for name, score in found.items()}


class Diagnosed(NamedTuple):
    """A row of the table: an encoder, and its named numbers."""

    task: str
    representation: str  # what tables call it; several encoders of a study may share a name
    sha256: str  # of the encoder
    values: Values


def diagnostics_text(rows: Iterable[Diagnosed]) -> str:
    """The table as its file has it."""
    cells = ((*row[:3], *(_cell(row.values.get(name)) for name in SCALARS)) for row in rows)
    return csv_text([*_COLUMNS], cells)


def read_diagnostics(path: Path, sha256: str | None = None) -> list[Diagnosed]:
    """The rows of the table.

    Args:
        path: of its file.
        sha256: of the file, if it is known.

    Raises:
        DamageError: it is not such a table, or has another SHA-256.
    """
    rows = read_csv(path, _COLUMNS, sha256)
    return [
        Diagnosed(task, name, sha256, dict(zip(SCALARS, values, strict=True)))
        for task, name, sha256, *values in rows
    ]


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _value(cell: str) -> float | None:
    return finite(cell) if cell else None


_COLUMNS: Columns = {
    **dict.fromkeys(("task", "representation", "sha256"), str),
    **dict.fromkeys(SCALARS, _value),
}


def by_label(rows: Iterable[Diagnosed]) -> dict[tuple[str, str], dict[str, float | None]]:
    """The values of each task and representation: the mean over its encoders that have one."""
    groups: dict[tuple[str, str], list[Values]] = {}
    for row in rows:
        groups.setdefault((row.task, row.representation), []).append(row.values)
    return {label: _means(values) for label, values in groups.items()}


def _means(several: Sequence[Values]) -> dict[str, float | None]:
    names = dict.fromkeys(name for values in several for name in values)
    known = {name: [v for each in several if (v := each.get(name)) is not None] for name in names}
    return {name: math.fsum(each) / len(each) if each else None for name, each in known.items()}
