"""Do scores tell which codes serve? python tools/worth.py results/worth-TASK ...

Each folder has the tables of a study of one task and, in scores/, the evaluation of its encoders
with --worth. A code's score is compared with the mean final return of all its runs but one, for
each that can be left out, and the one left out is the rival: the short run that would have been
trained instead, as far as each of its evaluations. Printed is how well each ranks the codes:
Spearman's correlation in each task, and its mean over tasks with a 95 % interval over families of
codes, and by how much that is above *rewarded* and above a short run of the same CPU time.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.errors import InputError
from jbrep.evaluate.evaluation import EVALUATION, Evaluation
from jbrep.evaluate.table import headline
from jbrep.records.document import read_document
from jbrep.report.tables import Tables, read_tables
from jbrep.report.worth import shown
from jbrep.stats.association import difference, mean_rank_correlation
from jbrep.stats.bootstrap import Array, Interval
from jbrep.study.tables import by_run
from jbrep.text import Table, interval

SCORES = "scores"
REWARDED = "rewarded"
EQUAL = "30% of a run"  # costs as much as to score a code: half a minute
Pairs = list[tuple[Array, Array]]  # what is said of each code, and what others' runs returned


class Told(NamedTuple):
    """What was known of the codes of a task, and what they returned.

    Attributes:
        task: that the agents learned.
        families: of the codes, (n,).
        pairs: for each run that is left out, by what tells.
    """

    task: str
    families: list[str]
    pairs: Mapping[str, Pairs]


def told(folder: Path) -> Told:
    """What the tables of a study and the evaluation of its encoders say.

    Raises:
        InputError: agents trained on others than those that have scores; or as `read_tables`.
    """
    tables = read_tables(folder)
    evaluation = read_document(folder / SCORES / EVALUATION, Evaluation)
    check(evaluation, tables)
    kinds = {
        each.settings.representation: each.encoder.kind for each in tables.record.labels.values()
    }
    codes = [code for code in kinds if code != FULL]
    finals, curves, steps = returned(tables, codes)
    others = (finals.sum(1, keepdims=True) - finals) / (finals.shape[1] - 1)
    pairs: dict[str, Pairs] = {
        name: [(np.array([said[code] for code in codes]), each) for each in others.T]
        for name, said in scores(evaluation).items()
    }
    short = {
        f"{step / steps[-1]:.0%} of a run": [*zip(curves[..., g].T, others.T, strict=True)]
        for g, step in enumerate(steps)
        if step > 0
    }
    return Told(evaluation.data.task, [kinds[code] for code in codes], {**pairs, **short})


def scores(evaluation: Evaluation) -> dict[str, Mapping[str, float]]:
    """What was said of every code before agents trained, by what said it."""
    known = {code: headline(each)[REWARDED] or 0.0 for code, each in evaluation.encoders.items()}
    ways = evaluation.worth.learned if evaluation.worth else {}
    said = {way: {c: shown(each).value or 0.0 for c, each in ways[way].items()} for way in ways}
    return {REWARDED: known, **{way: each for way, each in said.items() if each.keys() >= {*known}}}


def returned(tables: Tables, codes: Sequence[str]) -> tuple[Array, Array, Array]:
    """Final returns (codes, runs), mean returns of evaluations (codes, runs, g), their steps (g,).

    Raises:
        InputError: runs are missing.
    """
    if tables.analysis is None or len(tables.analysis.groups) != 1:
        raise InputError(f"{tables.name} has no runs of one task to compare: run the study first")
    (group,) = tables.analysis.groups
    labels = {each.representation: each for each in group.labels}
    evaluated = by_run(tables.returns)

    def curve(code: str, seed: int) -> list[float]:
        by_step = evaluated[f"{group.task}/{group.algorithm}/{code}", seed]
        return [float(np.mean(by_step[int(step)])) for step in group.grid]

    try:
        finals = np.stack([labels[code].by_run["final_return"] for code in codes])
        curves = [[curve(code, seed) for seed in labels[code].seeds] for code in codes]
        return finals, np.array(curves), group.grid
    except (KeyError, ValueError) as error:
        raise InputError(f"{tables.name} lacks runs: run the study to its end") from error


def check(evaluation: Evaluation, tables: Tables) -> None:
    """Check that agents trained on the very encoders that have scores.

    Raises:
        InputError: on others.
    """
    for run in tables.record.runs:
        code = tables.record.labels[run.label].settings.representation
        if code != FULL and evaluation.hashes.get(code) != run.encoder:
            raise InputError(f"{run.label}: agents trained on another code than the one scored")


def main(*folders: str) -> None:
    tasks = [told(Path(each)) for each in folders]
    families = tasks[0].families
    if any(each.families != families for each in tasks):
        raise InputError("studies of different codes: there is nothing that is told of all")
    every = {name: [each.pairs[name] for each in tasks] for name in tasks[0].pairs}
    rivals = [each for each in (REWARDED, EQUAL) if each in every]

    def together(name: str) -> Pairs:
        return [pair for pairs in every[name] for pair in pairs]

    def cells(name: str) -> list[Interval]:
        found = [mean_rank_correlation(pairs, families) for pairs in (*every[name], together(name))]
        above = [difference(together(name), together(rival), families) for rival in rivals]
        return found + above

    rows = [(name, *(interval(each.tolist(), ".2f") for each in cells(name))) for name in every]
    header = ("told by", *(each.task for each in tasks), "mean", *(f"above {r}" for r in rivals))
    counts = f"{len(families)} codes of {len({*families})} families"
    print(Table(f"Rank correlations with mean final returns, {counts}", header, rows).text())


if __name__ == "__main__":
    main(*sys.argv[1:])
