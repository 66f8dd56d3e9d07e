"""A run's folder: what a run leaves there, written and read."""

import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.errors import InputError, check_version
from jbrep.files.storage import exists, read_regular, write_whole
from jbrep.files.tables import write_csv

FORMAT = "jbrep run"
FORMAT_VERSION = 1
RUN = "run.json"  # written last: the run is over where it is
POLICY = "policy.zip"
CHECKPOINT = "checkpoint.safetensors"  # while the run is under way
ENCODER = "encoder.safetensors"
EPISODES = "episodes.csv"
EVALUATIONS = "evaluations.csv"
EVALUATION_SEED = 1 << 31  # of the first episode of an evaluation; training's are smaller
FINISHED, FAILED = "finished", "failed"
_MAX_BYTES = 1 << 28


class Episode(NamedTuple):
    """An episode of training."""

    step: int  # of training, over all lanes, at its end
    lane: int
    episode_return: float
    length: int  # control steps
    diverged: bool  # its physics, which ended it


class Evaluation(NamedTuple):
    """An episode of the deterministic policy."""

    step: int  # of training before it
    episode: int  # the same number is the same start
    episode_return: float


def write_rows(path: Path, rows: Iterable[NamedTuple], kind: type[NamedTuple]) -> None:
    """Write a long table as CSV."""
    columns = [name.removeprefix("episode_") for name in kind._fields]
    write_csv(path, columns, ([_shown(value) for value in row] for row in rows))


def _shown(value: float) -> str | int:
    return f"{value:.3f}" if isinstance(value, float) else int(value)


def read_evaluations(folder: Path) -> list[Evaluation]:
    """The evaluations of a run.

    Raises:
        InputError: the file is missing or no such table.
    """
    path = folder / EVALUATIONS
    try:
        rows = list(csv.reader(read_text(path).splitlines()))
        if rows[0] != ["step", "episode", "return"]:
            raise ValueError
        return [Evaluation(int(step), int(e), float(r)) for step, e, r in rows[1:]]
    except (ValueError, IndexError):
        raise InputError(f"{path} is not a table of evaluations, or cut short") from None


def write_run(folder: Path, run: Mapping[str, Any]) -> None:
    """Write run.json."""
    record = {"format": FORMAT, "format_version": FORMAT_VERSION, **run}
    write_whole(folder / RUN, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())


def read_run(folder: Path) -> dict[str, Any]:
    """What run.json says of a run that is over.

    Raises:
        InputError: there is none, or it is something else.
    """
    path = folder / RUN
    if not exists(path):
        raise InputError(f"no run that is over in {folder}: a {RUN} is expected")
    try:
        run = json.loads(read_text(path))
        version = run.get("format_version", 1)  # the first ones didn't say
        fields = (run["settings"], run["status"], run["seconds"])
        kinds = (dict, str, float)
        if not all(isinstance(f, kind) for f, kind in zip(fields, kinds, strict=True)):
            raise TypeError
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{path} is damaged, or not of a run") from None
    check_version(path, version, FORMAT_VERSION)
    return {name: run[name] for name in run if name not in ("format", "format_version")}


def read_text(path: Path) -> str:
    """A table's text.

    Raises:
        InputError: it can't be read.
    """
    try:
        return read_regular(path, _MAX_BYTES).decode()
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
