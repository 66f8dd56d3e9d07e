"""The tables that a report is made from, read back from a study's folder, and their statistics."""

from pathlib import Path
from typing import NamedTuple

from jbrep.errors import InputError
from jbrep.evaluate.table import DIAGNOSTICS, by_label, read_diagnostics
from jbrep.records.document import read_document
from jbrep.records.storage import exists
from jbrep.records.tables import read_rows
from jbrep.rl.files import ENCODER
from jbrep.stats import Analysis
from jbrep.study.record import RECORD, RunsRecord
from jbrep.study.results import found
from jbrep.study.tables import (
    REFERENCE_RETURNS,
    RETURNS,
    RUN_INFOS,
    References,
    Return,
    RunInfo,
    read_references,
)


class Tables(NamedTuple):
    """The tables of a study, and what the statistics say of them."""

    name: str
    record: RunsRecord  # runs.json
    returns: list[Return]  # returns.csv
    infos: list[RunInfo]  # run-infos.csv
    references: References  # references.csv: returns by task and policy
    # diagnostics.csv: values by task and representation, then by name
    diagnostics: dict[tuple[str, str], dict[str, float | None]]
    analysis: Analysis | None  # None where runs allow no statistics
    left_out: list[str]  # what there are no statistics of, and why


def check_tables(folder: Path) -> None:
    """Make sure that a folder has the tables of a study."""
    if not exists(folder / RECORD):
        if any(folder.rglob(ENCODER)):
            raise InputError(f"no run in {folder} has ended yet: report them then")
        raise InputError(
            f"{folder} is not the folder of a study: it has neither runs nor a {RECORD}"
        )


def read_tables(folder: Path) -> Tables:
    """The tables in a folder, with statistics if they allow any.

    Args:
        folder: of a study, or any that `jbrep.study.results.write_tables` wrote tables into.
    """
    check_tables(folder)
    record = read_document(folder / RECORD, RunsRecord)
    sha256 = record.tables
    returns = read_rows(folder / RETURNS, Return, sha256.get(RETURNS, ""))
    references = read_references(folder, sha256.get(REFERENCE_RETURNS))
    told, known = sha256.get(RUN_INFOS), sha256.get(DIAGNOSTICS)
    infos = read_rows(folder / RUN_INFOS, RunInfo, told) if told else []
    rows = read_diagnostics(folder / DIAGNOSTICS, known) if known else []
    statistics = found(record, returns, references)
    name = folder.resolve().name.encode(errors="replace").decode()
    return Tables(name, record, returns, infos, references, by_label(rows), *statistics)
