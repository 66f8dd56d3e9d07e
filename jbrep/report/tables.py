"""The tables that a report is made from, read back from a study's folder and checked."""

from pathlib import Path
from typing import Any, Literal, NamedTuple, NotRequired, TypedDict

from jbrep.errors import DamageError, InputError
from jbrep.evaluate.table import DIAGNOSTICS, by_label, read_diagnostics
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, TASKS
from jbrep.records.storage import exists
from jbrep.records.tables import Columns, count, finite, read_csv
from jbrep.records.typed import read_json, typed
from jbrep.report.figures.curves import References, Return
from jbrep.report.figures.diagrams import LabelRecord, TaskRecord
from jbrep.rl.files import read_text
from jbrep.stats import Analysis
from jbrep.study import record
from jbrep.study.references import HAND_WRITTEN, REFERENCE_RETURNS, read_references
from jbrep.study.results import COLUMNS, RETURNS, STATISTICS

HEURISTIC_RETURNS = "heuristics.csv"  # of the first release
_REPRESENTATIONS = list[str | dict[str, Any]]  # names, or what a user's own are made of
_MOST = 1 << 53  # of a number: a float holds whole ones exactly
# of the first release, which had no other robot
_JITTERBUG: TaskRecord = {
    "action_low": [-1.0],
    "action_high": [1.0],
    "timestep": CONTROL_TIMESTEP,
}


class RunRecord(TypedDict):
    """A finished or failed run in runs.json."""

    label: str
    seed: int
    status: Literal["finished", "failed"]
    reason: str | None
    steps: int
    seconds: float


class RegistrationRecord(TypedDict):
    """Of a study that was registered."""

    sha256: str
    date: str  # ISO 8601, in UTC
    deviations: list[str]  # in sentences


class Record(TypedDict):
    """runs.json."""

    study: dict[str, Any] | None  # its settings; None for runs without a study
    registration: NotRequired[RegistrationRecord | None]
    missing: dict[str, int]  # unfinished runs: training steps done
    left_out: list[str]  # what has no statistics, and why
    versions: list[dict[str, str]]  # by package
    processors: list[str]
    labels: dict[str, LabelRecord]
    runs: list[RunRecord]


class Tables(NamedTuple):
    """The tables of a study."""

    name: str
    record: Record
    analysis: Analysis | None  # statistics.json
    returns: list[Return]  # returns.csv
    references: References  # references.csv: returns by task and policy
    # diagnostics.csv: values by task and representation, then by name
    diagnostics: dict[tuple[str, str], dict[str, float | None]]


def read_tables(folder: Path) -> Tables:
    """The tables in a folder.

    Raises:
        InputError: there is no study in it, or a file is damaged, missing, or of a newer jbrep.
    """
    if not exists(folder / record.RECORD):
        raise InputError(
            f"{folder} is not the folder of a study: it has neither runs nor a {record.RECORD}"
        )
    analysis = None
    if exists(folder / STATISTICS):
        analysis = Analysis.from_json(_text(folder / STATISTICS), folder / STATISTICS)
    returns = [Return(*row) for row in read_csv(folder / RETURNS, COLUMNS)]
    rows = read_diagnostics(folder / DIAGNOSTICS) if exists(folder / DIAGNOSTICS) else []
    name = folder.resolve().name.encode(errors="replace").decode()
    record_of_runs = _read_record(folder / record.RECORD)
    references = _read_references(folder)
    return Tables(name, record_of_runs, analysis, returns, references, by_label(rows))


def _read_references(folder: Path) -> References:
    """Returns of reference policies; the first release had hand-written ones alone."""
    if exists(folder / REFERENCE_RETURNS):
        return read_references(folder)
    references: References = {}
    if exists(folder / HEURISTIC_RETURNS):
        columns: Columns = {"task": str, "episode": count, "return": finite}
        for task, _, each in read_csv(folder / HEURISTIC_RETURNS, columns):
            references.setdefault(task, {}).setdefault(HAND_WRITTEN, []).append(each)
    return references


def _read_record(path: Path) -> Record:
    value = read_json(_text(path), path, record.RunsRecord.format, 1)
    try:
        checked: Record = typed(value, Record)
        _check(checked)
    except ValueError as error:
        raise DamageError(f"{path} is damaged: {error}") from None
    for shared in checked["labels"].values():
        if shared["settings"]["task"] in TASKS:
            shared["settings"].setdefault("environment", _JITTERBUG)
    return checked


def _check(checked: Record) -> None:
    """Make sure that the parts of a record fit together.

    Raises:
        ValueError: they don't.
    """
    if not checked["runs"]:
        raise ValueError("it has no finished run")
    if study := checked["study"]:
        typed(study.get("algorithms"), list[str], where="study.algorithms")
        typed(study.get("representations"), _REPRESENTATIONS, where="study.representations")
        typed(study.get("learners", {}), dict[str, dict[str, Any]], where="study.learners")
    if "jbrep" not in (*checked["versions"], {})[0]:
        raise ValueError("the version of jbrep is missing")
    for run in checked["runs"]:
        if run["label"] not in checked["labels"]:
            raise ValueError(f"settings of {run['label']} are missing")
    for label, shared in checked["labels"].items():
        layers = [*shared["encoder"]["encoder"], *shared["encoder"]["decoder"]]
        if any(not 0 < size < _MOST for size, _ in [(shared["encoder"]["size"], ""), *layers]):
            raise ValueError(f"the encoder of {label} has sizes that are not positive")


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except UnicodeDecodeError:
        raise DamageError(f"{path} is damaged: it is not UTF-8") from None
