"""The tables of a study: returns of its runs and of reference policies, diagnostics of encoders."""

import warnings
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.envs.task import Array, Task
from jbrep.errors import DamageError, InputError, Notice
from jbrep.evaluate.evaluation import EVALUATION, Evaluation
from jbrep.evaluate.table import (
    DIAGNOSTICS,
    Diagnosed,
    Values,
    diagnostics_text,
    headline,
    read_diagnostics,
)
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.play.sources import find_player
from jbrep.records.document import read_document
from jbrep.records.storage import exists
from jbrep.records.tables import hash_of, read_rows, rounded, write_csv, write_text
from jbrep.stats.scale import CONSTANT, LOOKING, RANDOM, STILL
from jbrep.study.record import RECORD, RunsRecord
from jbrep.text import slug

RETURNS = "returns.csv"
REFERENCE_RETURNS = "references.csv"
RUN_INFOS = "run-infos.csv"  # a run may be in the same folder: its own table is infos.csv
_POLICIES = {
    STILL: "still",
    CONSTANT: "constant:drive=0.75",  # of five, what moves the Jitterbug furthest
    RANDOM: "uniform",
    LOOKING: "heuristic",
}
References = dict[str, dict[str, list[float]]]  # returns by task and policy

_TASK = "{task}"  # in an evaluation's path: the task's name as in folders
_Key = tuple[str, str]  # a task, and an encoder's SHA-256 or `full`


class Return(NamedTuple):
    """A row of returns.csv: an episode of an evaluation."""

    task: str
    algorithm: str
    representation: str
    seed: int
    step: int
    episode: int
    episode_return: float


class RunInfo(NamedTuple):
    """A row of run-infos.csv: a number that the environment told of such an episode."""

    task: str
    algorithm: str
    representation: str
    seed: int
    step: int
    episode: int
    name: str
    value: float


class _Reference(NamedTuple):
    """A row of references.csv: an episode of a reference policy."""

    task: str
    policy: str
    episode: int
    episode_return: float


def run_of(row: Return | RunInfo) -> tuple[str, int]:
    """The label and the seed of a row's run."""
    return f"{row.task}/{row.algorithm}/{row.representation}", row.seed


def by_run(returns: Iterable[Return]) -> dict[tuple[str, int], dict[int, list[float]]]:
    """The returns of each run's evaluations, by the run's label and seed, then by step."""
    found: dict[tuple[str, int], dict[int, list[float]]] = {}
    for row in returns:
        by_step = found.setdefault(run_of(row), {})
        by_step.setdefault(row.step, []).append(row.episode_return)
    return found


def former_record(folder: Path) -> RunsRecord | None:
    """What runs.json in a folder says; None where that is missing or can't be read."""
    try:
        return read_document(folder / RECORD, RunsRecord)
    except InputError:
        return None


def table_hashes(folder: Path) -> Mapping[str, str]:
    """The SHA-256 of each table by runs.json; none where that is missing or can't be read."""
    former = former_record(folder)
    return former.tables if former else {}


def write_references(
    tasks: Iterable[tuple[Task, int]],
    folder: Path,
    before: Mapping[str, str],
    played_on: Mapping[str, Task] = {},
    top: str | float = "",
) -> str | None:
    """Play the reference policies of tasks: three that don't look, and hand-written if there is.

    What the file has already isn't played again; what can't be played stays in it.

    Args:
        tasks: each with its number of episodes.
        folder: for the file.
        before: what runs.json says of the tables. A file that is another is written anew.
        played_on: tasks by name as they were then; those that were others are played anew.
        top: a further policy, which scores 1; a return isn't played.

    Returns:
        The SHA-256 of the file; None if there is nothing to write.

    Raises:
        DamageError: the file is another, and what was in it can't be played here.
    """
    path, damage = folder / REFERENCE_RETURNS, None
    try:
        there = _there(path, before)
    except DamageError as error:
        there, damage = [], error
    rows = []
    for task, episodes in sorted(tasks, key=lambda each: each[0].name):
        for policy in _policies(task, top):
            own = [row for row in there if (row.task, row.policy) == (task.name, policy)]
            if played_on.get(task.name, task) != task:
                own = []
            if [row.episode for row in own] != [*range(episodes)]:
                try:
                    own = _played(task, policy, episodes)
                except Exception as error:  # what has been trained is reported all the same
                    told = f"policy {policy!r} couldn't be played on {task.name}: {error}"
                    warnings.warn(told, Notice, stacklevel=2)
            if damage and not own:
                raise damage
            rows += own
    return write_csv(path, ("task", "policy", "episode", "return"), rows) if rows else None


def references_of(task: Task, episodes: int) -> dict[str, Array]:
    """Returns of the reference policies of a task in its first episodes, by policy.

    There is none of an environment that isn't installed.
    """
    found: dict[str, Array] = {}
    for policy in _policies(task):
        with suppress(Exception):  # a run is told of all the same
            rows = _played(task, policy, episodes)
            found[policy] = np.array([row.episode_return for row in rows])
    return found


def hash_of_references(folder: Path, before: Mapping[str, str]) -> str | None:
    """The SHA-256 of references.csv, which must be what it was before; None if there is none."""
    path = folder / REFERENCE_RETURNS
    if not exists(path):
        return None
    read_rows(path, _Reference, before.get(REFERENCE_RETURNS))
    return hash_of(path.read_text())


def read_references(folder: Path, sha256: str | None) -> References:
    """What `write_references` wrote.

    Args:
        folder: that the file is in.
        sha256: of the file; None if there was nothing to write.

    Raises:
        DamageError: it isn't what was written.
    """
    found: References = {}
    for row in read_rows(folder / REFERENCE_RETURNS, _Reference, sha256) if sha256 else []:
        found.setdefault(row.task, {}).setdefault(row.policy, []).append(row.episode_return)
    return found


def _policies(task: Task, top: str | float = "") -> Iterator[str]:
    """The reference policies that a task has, and one that is named."""
    yield from (policy for policy in _POLICIES if policy != LOOKING or task.name in HEURISTICS)
    if isinstance(top, str) and top:
        yield top


def _there(path: Path, before: Mapping[str, str]) -> list[_Reference]:
    """What the file has; nothing if there is none."""
    if not exists(path):
        return []
    return read_rows(path, _Reference, before.get(REFERENCE_RETURNS, "") if before else None)


def _played(task: Task, policy: str, episodes: int) -> list[_Reference]:
    """The rows of a task and policy."""
    one_by_one = None if task.reproducible else 1  # a robot may exist once
    returns = find_player(_POLICIES.get(policy, policy), task).returns(episodes, one_by_one)
    return [_Reference(task.name, policy, i, rounded(each)) for i, each in enumerate(returns)]


def add_diagnostics(folder: Path, given: Sequence[str] = ()) -> list[str]:
    """Write what evaluations say of the encoders of a study's runs, if any is named.

    Evaluations are matched by the encoders' hashes, the whole observation by the task. What the
    table says already is kept where they say nothing.

    Args:
        folder: with the tables of a study.
        given: folders of evaluations beside those that the study names; {task} stands for each
            task in turn. The first that knows an encoder counts.

    Returns:
        A line for each task with representations that no evaluation knows.

    Raises:
        DamageError: a file is damaged.
    """
    path, runs = folder / DIAGNOSTICS, folder / RECORD
    if not exists(runs):
        return []
    record = read_document(runs, RunsRecord)
    named = record.study.evaluations if record.study else ()
    if not (given or named or exists(path)):
        return []
    used = _encoders(record)
    known: dict[_Key, Values] = {}
    for pattern in dict.fromkeys((*given, *named)):
        files = _files(pattern, (row.task for row in used))
        if pattern in given and not files:
            raise InputError(f"no evaluation in {pattern}: jbrep evaluate makes one")
        for file in files:
            known = evaluated(file) | known
    if exists(path):
        known = _there_too(path, record.tables.get(DIAGNOSTICS), used, known) | known
    rows = [row._replace(values=known[_key(row)]) for row in used if _key(row) in known]
    text = diagnostics_text(rows)
    tables = {**record.tables, DIAGNOSTICS: hash_of(text)}
    if tables != record.tables:  # a kill in between leaves no hash of another table there
        others = {name: sha256 for name, sha256 in tables.items() if name != DIAGNOSTICS}
        record.replace(tables=others).write(runs)
    write_text(path, text)
    if tables != record.tables:
        record.replace(tables=tables).write(runs)
    return list(_unknown(used, known))


def _there_too(
    path: Path, sha256: str | None, used: Iterable[Diagnosed], known: Mapping[_Key, Values]
) -> dict[_Key, Values]:
    """What the table says already; one that is another isn't needed where all is known.

    Args:
        path: of the table.
        sha256: of it; None if that isn't known, as where runs.json is written anew.
        used: encoders.
        known: of them already.

    Raises:
        DamageError: the table is another, and some of the encoders are known from it alone.
    """
    try:
        return {_key(row): row.values for row in read_diagnostics(path, sha256)}
    except DamageError:
        if all(_key(row) in known for row in used):
            return {}
        raise


def _encoders(record: RunsRecord) -> list[Diagnosed]:
    """A row without values for each encoder under each name in each task."""
    rows = dict.fromkeys(
        (settings.task, settings.representation, run.encoder)
        for run in record.runs
        for settings in [record.labels[run.label].settings]
    )
    return [Diagnosed(*row, {}) for row in rows]


def _files(pattern: str, tasks: Iterable[str]) -> list[Path]:
    """The evaluations that a folder's path stands for, as far as they are there."""
    folders = dict.fromkeys(Path(pattern.replace(_TASK, slug(task))) for task in tasks)
    return [file for folder in folders if exists(file := folder / EVALUATION)]


def evaluated(path: Path) -> dict[_Key, Values]:
    """The headline numbers in an evaluation."""
    evaluation = read_document(path, Evaluation)
    task = evaluation.data.task
    return {
        (task, known.sha256 or label): headline(known)
        for label, known in evaluation.encoders.items()
        if label == FULL or known.sha256
    }


def _key(row: Diagnosed) -> _Key:
    return row.task, FULL if row.representation == FULL else row.sha256


def _unknown(used: Sequence[Diagnosed], known: Mapping[_Key, Values]) -> Iterator[str]:
    """What to do about the representations of each task without numbers."""
    encoders = Counter(row[:2] for row in used)
    missing = Counter(row[:2] for row in used if _key(row) not in known)
    names = defaultdict[str, list[str]](list)
    for (task, name), lacking in missing.items():
        total = encoders[task, name]
        names[task].append(name if total == 1 else f"{name} ({lacking} of {total} encoders)")
    for task, unknown in names.items():
        yield (
            f"no diagnostics for {task} of {', '.join(unknown)}: evaluate them, then jbrep report "
            "--evaluation"
        )
