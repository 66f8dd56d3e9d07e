"""Do scores tell which codes serve? python tools/worth.py results/worth results/worth/TASK ...

The first folder has the tables of a study; the others have evaluations with --worth of its
encoders, each of one task. Printed is how well each score ranks the mean final returns of the
codes: Spearman's correlation in each task, and its mean over tasks with a 95 % interval over
families of codes, and by how much that is above the mean of *rewarded* and of the short run.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jbrep.encoders import FULL
from jbrep.errors import InputError
from jbrep.evaluate.evaluation import EVALUATION, Evaluation
from jbrep.evaluate.table import headline
from jbrep.records.document import read_document
from jbrep.report.tables import Tables, read_tables
from jbrep.report.worth import shown
from jbrep.stats.association import difference, mean_rank_correlation, rank_correlation
from jbrep.stats.bootstrap import Array, Interval
from jbrep.text import Table, interval
from jbrep.worth import AGENT

REWARDED = "rewarded"
RIVALS = (REWARDED, AGENT)


def scores(evaluation: Evaluation) -> dict[str, Mapping[str, float]]:
    """What was said of every code before agents trained, by what said it."""
    known = {code: headline(each)[REWARDED] or 0.0 for code, each in evaluation.encoders.items()}
    ways = evaluation.worth.learned if evaluation.worth else {}
    told = {way: {c: shown(each).value or 0.0 for c, each in ways[way].items()} for way in ways}
    return {REWARDED: known, **{way: each for way, each in told.items() if each.keys() >= {*known}}}


def final_returns(tables: Tables, task: str) -> dict[str, float]:
    """The mean final return of a task's runs, by code."""
    groups = tables.analysis.groups if tables.analysis else ()
    return {
        label.representation: float(label.numbers["final_return_mean"].value)
        for group in groups
        for label in group.labels
        if group.task == task and label.representation != FULL
    }


def check(evaluation: Evaluation, tables: Tables) -> None:
    """Check that agents trained on the very encoders that have scores.

    Raises:
        InputError: on others.
    """
    task = evaluation.data.task
    for run in tables.record.runs:
        settings = tables.record.labels[run.label].settings
        code = settings.representation
        if settings.task == task and code != FULL and evaluation.hashes.get(code) != run.encoder:
            raise InputError(f"agents on {task} trained on another {code} than the one with scores")


def main(study: str, *evaluations: str) -> None:
    tables = read_tables(Path(study))
    pairs: dict[str, list[tuple[Array, Array]]] = {}
    tasks, codes = [], list[str]()
    for folder in evaluations:
        evaluation = read_document(Path(folder) / EVALUATION, Evaluation)
        check(evaluation, tables)
        tasks.append(evaluation.data.task)
        returned = final_returns(tables, tasks[-1])
        codes = codes or [*returned]
        for score, numbers in scores(evaluation).items():
            x, y = (np.array([each[code] for code in codes]) for each in (numbers, returned))
            pairs.setdefault(score, []).append((x, y))
    kinds = {
        each.settings.representation: each.encoder.kind for each in tables.record.labels.values()
    }
    families = [kinds[code] for code in codes]
    rivals = [each for each in RIVALS if each in pairs]

    def cells(score: str) -> list[Interval]:
        own = pairs[score]
        found = [rank_correlation(*each, families) for each in own]
        found.append(mean_rank_correlation(own, families))
        return found + [difference(own, pairs[rival], families) for rival in rivals]

    rows = [(score, *(interval(each.tolist(), ".2f") for each in cells(score))) for score in pairs]
    header = ("score", *tasks, "mean", *(f"above {rival}" for rival in rivals))
    counts = f"{len(codes)} codes of {len({*families})} families"
    print(Table(f"Rank correlations with the mean final return, {counts}", header, rows).text())


if __name__ == "__main__":
    main(*sys.argv[1:])
