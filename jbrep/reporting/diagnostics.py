"""What evaluations say of the encoders of a study's runs: diagnostics.csv, beside its returns."""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from jbrep.encoders import FULL
from jbrep.errors import DamageError, InputError
from jbrep.evaluation.evaluation import EVALUATION, Evaluation
from jbrep.evaluation.table import (
    DIAGNOSTICS,
    Diagnosed,
    Values,
    diagnostics_text,
    headline,
    read_diagnostics,
)
from jbrep.records.document import read_document
from jbrep.records.storage import exists
from jbrep.records.tables import write_text
from jbrep.studies.prepare import EVALUATIONS
from jbrep.studies.record import RECORD, RunsRecord
from jbrep.text import slug

_TASK = "{task}"  # in an evaluation's path: the task's name as in folders
_Encoder = tuple[str, str]  # a task, and an encoder's SHA-256 or `full`


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
    record = read_document(folder / RECORD, RunsRecord)
    named = record.study.evaluations if record.study else ()
    own = sorted((folder / EVALUATIONS).rglob(EVALUATION))
    if not (given or named or own or DIAGNOSTICS in record.tables):
        return []
    used = [
        Diagnosed(*key, {})
        for key in dict.fromkeys(
            (settings.task, settings.representation, run.encoder)
            for run in record.runs
            for settings in [record.labels[run.label].settings]
        )
    ]
    every = list[Path]()
    for pattern in dict.fromkeys((*given, *named)):
        folders = dict.fromkeys(Path(pattern.replace(_TASK, slug(row.task))) for row in used)
        files = [file for each in folders if exists(file := each / EVALUATION)]
        if pattern in given and not files:
            raise InputError(f"no evaluation in {pattern}: jbrep evaluate makes one")
        every += files
    known: dict[_Encoder, Values] = {}
    for file in (*every, *own):
        known = evaluated(file) | known
    try:
        known = {_key(row): row.values for row in read_known(folder, record)} | known
    except DamageError:  # which doesn't matter if the evaluations know all
        if not all(_key(row) in known for row in used):
            raise
    text = diagnostics_text([r._replace(values=known[_key(r)]) for r in used if _key(r) in known])
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    if record.tables.get(DIAGNOSTICS) != sha256 or not exists(folder / DIAGNOSTICS):
        write_text(folder / DIAGNOSTICS, text)
        record.with_table(DIAGNOSTICS, sha256).write(folder / RECORD)
    return list(_unknown(used, known))


def read_known(folder: Path, record: RunsRecord) -> list[Diagnosed]:
    """The rows of the table, if runs.json knows one."""
    if DIAGNOSTICS not in record.tables:
        return []
    return read_diagnostics(folder / DIAGNOSTICS, record.tables[DIAGNOSTICS])


def evaluated(path: Path) -> dict[_Encoder, Values]:
    """The headline numbers in an evaluation."""
    evaluation = read_document(path, Evaluation)
    task = evaluation.data.task
    return {
        (task, known.sha256 or label): headline(known)
        for label, known in evaluation.encoders.items()
        if label == FULL or known.sha256
    }


def _key(row: Diagnosed) -> _Encoder:
    return row.task, FULL if row.representation == FULL else row.sha256


def _unknown(used: Sequence[Diagnosed], known: Mapping[_Encoder, Values]) -> Iterator[str]:
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
