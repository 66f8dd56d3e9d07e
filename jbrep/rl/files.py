"""A run's folder: what a run leaves there, written and read."""

import csv
import math
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from jbrep.errors import DamageError, InputError
from jbrep.records import container
from jbrep.records.document import read_document
from jbrep.records.storage import exists, read_regular
from jbrep.records.tables import write_csv
from jbrep.rl.record import PolicyHeader, RunRecord
from jbrep.rl.settings import MAX_EPISODES, MAX_STEPS

POLICY_SUFFIX = ".safetensors"
RUN = "run.json"  # written last: its presence means that the run has ended
POLICY = "policy.safetensors"
POLICY_ZIP = "policy.zip"  # the same for stable-baselines3; jbrep doesn't read it
CHECKPOINT = "checkpoint.safetensors"  # until the run ends
BEGINNING = "beginning.safetensors"  # the policy that it begins with, if that is another run's
ENCODER = "encoder.safetensors"
EPISODES = "episodes.csv"
EVALUATIONS = "evaluations.csv"
EVALUATION_SEED = 1 << 31  # of an evaluation's first episode; seeds in training are smaller
_MAX_TABLE_BYTES = 1 << 28


class Episode(NamedTuple):
    """An episode of training."""

    step: int  # of training, over all lanes, at its end
    lane: int
    episode_return: float
    length: int  # steps
    diverged: bool  # whether its physics did, which ended it


class Evaluation(NamedTuple):
    """An episode of the deterministic policy."""

    step: int  # of training before it
    episode: int  # the same number has the same start
    episode_return: float


def is_run(folder: Path) -> bool:
    """Whether a folder is of a run that has ended or has written a checkpoint."""
    return exists(folder / RUN) or exists(folder / CHECKPOINT)


def runs_below(folder: Path) -> list[Path]:
    """The folders of the runs below a folder that have finished or failed, in order."""
    return sorted(file.parent for file in folder.rglob(RUN))


def is_policy_file(path: Path) -> bool:
    """Whether this is a policy's file as `jbrep.rl.policy_file` writes it."""
    return path.suffix == POLICY_SUFFIX and container.format_of(path) == PolicyHeader.format


def write_rows(path: Path, rows: Iterable[NamedTuple], kind: type[NamedTuple]) -> None:
    """Write a long table as CSV."""
    columns = [name.removeprefix("episode_") for name in kind._fields]
    write_csv(path, columns, ([_cell(value) for value in row] for row in rows))


def _cell(value: float) -> str | int:
    return f"{value:.3f}" if isinstance(value, float) else int(value)


def read_evaluations(folder: Path) -> list[Evaluation]:
    """The evaluations of a run: ascending steps, each with the same episodes from 0.

    The last one may have more of them.

    Raises:
        InputError: the file is missing.
        DamageError: it is not such a table.
    """
    path = folder / EVALUATIONS
    try:
        header, *rows = csv.reader(read_text(path).splitlines(), strict=True)
        if header != ["step", "episode", "return"]:
            raise ValueError
        evaluations = [_evaluation(*row) for row in rows]
        _check_grid(evaluations)
    except (ValueError, TypeError, csv.Error):
        raise DamageError(
            f"{path} is damaged or not a table of evaluations: its columns must be step, episode "
            "and a finite return, with the same episodes at every step, or more at the last"
        ) from None
    return evaluations


def _evaluation(step: str, episode: str, episode_return: str) -> Evaluation:
    row = Evaluation(int(step), int(episode), float(episode_return))
    in_range = 0 <= row.step <= MAX_STEPS and 0 <= row.episode < MAX_EPISODES
    if not in_range or not math.isfinite(row.episode_return):
        raise ValueError
    return row


def _check_grid(evaluations: list[Evaluation]) -> None:
    steps, counts = [], []
    for step, rows in groupby(evaluations, lambda row: row.step):
        episodes = [row.episode for row in rows]
        if episodes != [*range(len(episodes))]:
            raise ValueError
        steps.append(step)
        counts.append(len(episodes))
    if steps != sorted(set(steps)) or len(set(counts[:-1])) > 1 or counts[-1:] < counts[:1]:
        raise ValueError


def read_run(folder: Path) -> RunRecord:
    """What run.json says of a run that has ended.

    Raises:
        InputError: there is none, or it has another version of the format.
        DamageError: it is damaged or something else.
    """
    path = folder / RUN
    if not exists(path):
        raise InputError(f"no finished run in {folder}: {RUN} is missing")
    return read_document(path, RunRecord)


def read_finished(folder: Path) -> tuple[RunRecord, str]:
    """The same of a run that has ended well, and the SHA-256 of its policy's file.

    Raises:
        InputError: as `read_run`, or the run failed.
        DamageError: as `read_run`.
    """
    run = read_run(folder)
    if run.policy_sha256 is None:
        raise InputError(f"the run in {folder} {run.status}: it has no policy")
    return run, run.policy_sha256


def read_text(path: Path, most: int = _MAX_TABLE_BYTES) -> str:
    """A file's text; empty for one of more than `most` bytes, or that isn't a regular file.

    Raises:
        InputError: it can't be read.
        UnicodeDecodeError: it isn't UTF-8.
    """
    try:
        return read_regular(path, most).decode()
    except OSError as error:
        raise InputError(f"can't read {path}: {error.strerror or error}") from error
