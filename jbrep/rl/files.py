"""A run's folder: what a run leaves there, written and read."""

import csv
import json
import math
from collections.abc import Iterable, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.errors import DamageError, InputError, check_version, differences
from jbrep.records import container
from jbrep.records.storage import exists, read_regular, write_whole
from jbrep.records.tables import write_csv
from jbrep.rl.fields import FAILED as FAILED
from jbrep.rl.fields import FINISHED as FINISHED
from jbrep.rl.fields import (
    MAX_EVALUATION_EPISODES,
    MAX_STEPS,
    check_run,
    completed,
    from_version_1,
)

FORMAT = "jbrep run"
FORMAT_VERSION = 2
POLICY_FORMAT = "jbrep policy"
POLICY_SUFFIX = ".safetensors"
RUN = "run.json"  # written last: its presence means that the run has ended
POLICY = "policy.zip"
CHECKPOINT = "checkpoint.safetensors"  # until the run ends
BEGINNING = "beginning.zip"  # the policy of another run that this one begins with, if it does
ENCODER = "encoder.safetensors"
EPISODES = "episodes.csv"
EVALUATIONS = "evaluations.csv"
EVALUATION_SEED = 1 << 31  # of an evaluation's first episode; seeds in training are smaller
_MAX_TABLE_BYTES = 1 << 28
_MAX_RUN_BYTES = 1 << 22


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
    """Whether this is a policy's file as `jbrep.rl.policy_weights` writes it."""
    return path.suffix == POLICY_SUFFIX and container.format_of(path) == POLICY_FORMAT


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
    in_range = 0 <= row.step <= MAX_STEPS and 0 <= row.episode < MAX_EVALUATION_EPISODES
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


def write_run(folder: Path, run: Mapping[str, Any]) -> None:
    """Write run.json."""
    record = {"format": FORMAT, "format_version": FORMAT_VERSION, **run}
    write_whole(folder / RUN, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())


def read_run(folder: Path) -> dict[str, Any]:
    """What run.json says of a run that has ended, every field checked, in this version's form.

    Raises:
        InputError: there is none, or it is from a newer jbrep.
        DamageError: it is damaged or something else.
    """
    path = folder / RUN
    if not exists(path):
        raise InputError(f"no finished run in {folder}: {RUN} is missing")
    run = _read_json(path)
    version = run.pop("format_version", 1)
    if run.pop("format", FORMAT) != FORMAT or type(version) is not int:
        raise DamageError(f"{path} is damaged or not from a jbrep run: its format is another")
    check_version(path, version, FORMAT_VERSION)
    if version == 1 and isinstance(run.get("settings"), dict):
        run["settings"] = from_version_1(path, run["settings"])
    if isinstance(run.get("settings"), dict):
        run["settings"] = completed(run["settings"])
    check_run(path, run)
    return run


def read_finished(folder: Path) -> dict[str, Any]:
    """What run.json says of a run that has ended well; it has the policy's hash.

    Raises:
        InputError: as `read_run`, or the run failed.
        DamageError: as `read_run`, or there is no hash.
    """
    run = read_run(folder)
    if run["status"] != FINISHED:
        raise InputError(f"the run in {folder} {run['status']}: it has no policy")
    if "policy_sha256" not in run:
        raise DamageError(f"{folder / RUN} is damaged: policy_sha256 is missing")
    return run


def differing(there: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """The settings of two runs that differ, as text for a message; empty if none does."""
    return differences(_flat(there), _flat(wanted))


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with those of the environment among them."""
    own = dict(settings)
    environment = own.pop("environment")
    return {**own, **environment}


def _read_json(path: Path) -> dict[str, Any]:
    """A JSON object of finite numbers and of text that can be written."""
    try:
        value = json.loads(
            read_text(path, _MAX_RUN_BYTES), parse_constant=_refuse, parse_float=_finite
        )
        json.dumps(value, ensure_ascii=False).encode()  # a lone surrogate can't be
        if not isinstance(value, dict):
            raise TypeError
        return value
    except (ValueError, TypeError, RecursionError):
        raise DamageError(
            f"{path} is damaged or not from a jbrep run: it must be a JSON object of finite numbers"
        ) from None


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not JSON")


def _finite(number: str) -> float:
    value = float(number)
    return value if math.isfinite(value) else _refuse(number)


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
