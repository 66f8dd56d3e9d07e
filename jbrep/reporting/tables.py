"""What a report is made from: the tables of a study, and the statistics of their runs."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from jbrep.errors import InputError, listed
from jbrep.evaluation.table import by_label
from jbrep.reporting.diagnostics import read_known
from jbrep.stats.analysis import Analysis, analyse
from jbrep.stats.curves import common_grid
from jbrep.stats.runs import RunCurve, groups
from jbrep.stats.scale import BLIND
from jbrep.studies import tables as study
from jbrep.studies.record import RunsRecord
from jbrep.studies.tables import References


class Tables(NamedTuple):
    """The tables of a study, and what the statistics say of them."""

    name: str
    raw: study.Tables  # as they were read
    # diagnostics.csv: values by task and representation, then by name
    diagnostics: dict[tuple[str, str], dict[str, float | None]]
    analysis: Analysis | None  # None where runs allow no statistics
    left_out: list[str]  # what there are no statistics of, and why


def read_tables(folder: Path) -> Tables:
    """The tables in a folder of a study, or of any runs, with statistics if they allow any."""
    tables = study.read_tables(folder)
    name = folder.resolve().name.encode(errors="replace").decode()
    diagnostics = by_label(read_known(folder, tables.record))
    return Tables(name, tables, diagnostics, *_statistics(tables))


def _statistics(tables: study.Tables) -> tuple[Analysis | None, list[str]]:
    """The statistics, if runs allow any; what there are none of, and why."""
    prevented = _prevented(tables.record, tables.references)
    curves, left_out = tables.curves()
    planned = replace(tables.record.planned, prevented=prevented)
    compared, alone = _comparable(curves, planned.rules.baseline)
    compared, refused = _without_refused(compared, planned.rules.baseline)
    left_out += alone + refused
    try:
        analysis = analyse(compared, planned, references=tables.references) if compared else None
        return analysis, left_out
    except InputError as error:
        return None, [*left_out, str(error)]


def _comparable(runs: list[RunCurve], baseline: str) -> tuple[list[RunCurve], list[str]]:
    """The runs that there can be statistics of, though others are missing; what is left out."""
    counts = Counter((run.task, run.algorithm, run.representation) for run in runs)
    alone = {key for key, count in counts.items() if count == 1}
    others = {key for key in counts if counts[*key[:2], baseline] < 2} - alone
    why = {
        "one run has ended, at least two are needed": alone,
        f"at least two runs of {baseline} are needed to compare it with": others,
    }
    kept = [
        run for run in runs if (run.task, run.algorithm, run.representation) not in alone | others
    ]
    said = {reason: listed(sorted(map("/".join, keys))) for reason, keys in why.items() if keys}
    return kept, [f"{names}: {reason}" for reason, names in said.items()]


def _without_refused(runs: list[RunCurve], baseline: str) -> tuple[list[RunCurve], list[str]]:
    """The runs of tasks and algorithms that there can be statistics of; why not of the others."""
    by_group: dict[tuple[str, str], list[RunCurve]] = {}
    for run in runs:
        by_group.setdefault((run.task, run.algorithm), []).append(run)
    kept, refused = list[RunCurve](), []
    for some in by_group.values():
        try:
            for group in groups(some, baseline).values():
                common_grid(group)
            kept += some
        except InputError as error:
            refused.append(str(error))
    return kept, refused


def _prevented(record: RunsRecord, references: References) -> dict[str, str]:
    """Why there are no verdicts on tasks, by name, where what scores 0 or 1 isn't known."""
    needed = [*BLIND, *filter(None, [record.planned.rules.policy])]
    unknown = {
        task: [policy for policy in needed if policy not in references.get(task, {})]
        for task in record.tasks
    }
    return {
        task: f"what {listed(policies)} would return isn't known, by which returns are scored: "
        "jbrep study plays them when it runs"
        for task, policies in unknown.items()
        if policies
    }
