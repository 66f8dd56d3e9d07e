"""How well scores rank codes: python tools/worth.py results/worth-TASK ...

Each folder has the tables of a study of one task and, in scores/, the evaluation of its encoders
with --worth. A code's score is compared with the mean final return of all its runs but one, for
each that can be left out. The one that is left out is the rival: what a single short run would have
said, which takes as long as to score a code one way, half a minute of CPU time. Whole runs show the
most that one of them can say.

Printed is Spearman's correlation in each task, and its mean over tasks with a 95 % interval over
families of codes, and by how much that is above *rewarded* and above the short run. What was hoped
for was written down before the first run: see PRIMARY. Then, for each task, what was said of every
code and what its agents returned.
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
from jbrep.stats.association import difference, mean_rank_correlation
from jbrep.stats.bootstrap import Array, Interval
from jbrep.study.tables import by_run
from jbrep.text import SIGNIFICANT, Table, interval, number

SCORES = "scores"
REWARDED, SHORT, WHOLE = "rewarded", "a short run", "a whole run"
SHORT_STEPS = 50_000  # until the first evaluation after them: half a minute
PRIMARY, LEAST, LEAST_LOW = "trees", 0.8, 0.6  # the mean over tasks, and its interval's low end
Pairs = list[tuple[Array, Array]]  # what is said of each code, and what others' runs returned


class Scored(NamedTuple):
    """The codes of a task with what was known of them beforehand, and what they returned.

    Attributes:
        task: that the agents learned.
        codes: n of them.
        families: of the codes, (n,).
        pairs: for each run that is left out, by what ranks the codes.
    """

    task: str
    codes: list[str]
    families: list[str]
    pairs: Mapping[str, Pairs]


def read(folder: Path) -> Scored:
    """What the tables of a study and the evaluation of its encoders say.

    Raises:
        InputError: agents trained on others than those that have scores; runs are missing; or as
            `read_tables`.
    """
    tables = read_tables(folder)
    evaluation = read_document(folder / SCORES / EVALUATION, Evaluation)
    check(evaluation, tables)
    kinds = {
        each.settings.representation: each.encoder.kind for each in tables.record.labels.values()
    }
    codes = [code for code in kinds if code != FULL]
    finals, short, whole = returned(tables, codes)
    others = (finals.sum(1, keepdims=True) - finals) / (finals.shape[1] - 1)
    pairs: dict[str, Pairs] = {
        name: [(np.array([score[code] for code in codes]), each) for each in others.T]
        for name, score in scores(evaluation).items()
    }
    for name, single in ((SHORT, short), (WHOLE, whole)):
        pairs[name] = [*zip(single.T, others.T, strict=True)]
    return Scored(evaluation.data.task, codes, [kinds[code] for code in codes], pairs)


def scores(evaluation: Evaluation) -> dict[str, Mapping[str, float]]:
    """What was known of every code before agents trained, by what found it out."""
    known = {code: headline(each)[REWARDED] or 0.0 for code, each in evaluation.encoders.items()}
    ways = evaluation.worth.learned if evaluation.worth else {}
    found = {way: {c: each.final.value or 0.0 for c, each in ways[way].items()} for way in ways}
    return {REWARDED: known, **{w: each for w, each in found.items() if each.keys() >= {*known}}}


def returned(tables: Tables, codes: Sequence[str]) -> tuple[Array, Array, Array]:
    """Final returns, and means of a short run's and a whole run's evaluation, (codes, runs) each.

    Raises:
        InputError: runs are missing, or no run is longer than a short one.
    """
    analysis = tables.analysis
    if analysis is None or len(analysis.groups) != 1 or tables.record.missing:
        raise InputError(f"{tables.name} lacks runs of one task: run the study to its end")
    (group,) = analysis.groups
    if not (later := [int(step) for step in group.grid if step >= SHORT_STEPS]):
        raise InputError(f"{tables.name} has runs of fewer than {SHORT_STEPS:,} steps")
    labels = {each.representation: each for each in group.labels}
    evaluated = by_run(tables.returns)

    def means(step: int) -> Array:
        of_runs = [
            [
                evaluated.get((f"{group.task}/{group.algorithm}/{code}", seed), {}).get(step)
                for seed in labels[code].seeds
            ]
            for code in codes
        ]
        failed = [group.failure_return]
        return np.array([[np.mean(each or failed) for each in runs] for runs in of_runs])

    finals = np.stack([labels[code].by_run["final_return"] for code in codes])
    return finals, means(later[0]), means(later[-1])


def check(evaluation: Evaluation, tables: Tables) -> None:
    """Check that agents trained on the very encoders that have scores.

    Raises:
        InputError: on others.
    """
    for run in tables.record.runs:
        code = tables.record.labels[run.label].settings.representation
        if code != FULL and evaluation.hashes.get(code) != run.encoder:
            raise InputError(f"{run.label}: agents trained on another code than the one scored")


def by_code(task: Scored) -> Table:
    """What was said of every code, beside the mean final return of its runs, the best first."""
    said = {name: np.mean([each for each, _ in pairs], 0) for name, pairs in task.pairs.items()}
    said["final return"] = np.mean([others for _, others in task.pairs[WHOLE]], 0)
    cells = {name: [number(each, SIGNIFICANT) for each in values] for name, values in said.items()}
    order = np.argsort(-said["final return"], kind="stable")
    rows = [(task.codes[i], *(of_codes[i] for of_codes in cells.values())) for i in order]
    return Table(f"{task.task}: scores and mean returns", ("code", *cells), rows)


def main(*folders: str) -> None:
    if not folders:
        raise SystemExit(__doc__)
    tasks = [read(Path(each)) for each in folders]
    first = tasks[0]
    for each in tasks:
        if each.codes != first.codes or each.pairs.keys() != first.pairs.keys():
            raise InputError(f"{each.task} has other codes or scores than {first.task}")

    def together(name: str) -> Pairs:
        return [pair for each in tasks for pair in each.pairs[name]]

    def cells(name: str) -> list[Interval]:
        alone = [mean_rank_correlation(each.pairs[name], first.families) for each in tasks]
        mean = mean_rank_correlation(together(name), first.families)
        rivals = [together(rival) for rival in (REWARDED, SHORT)]
        return [*alone, mean, *(difference(together(name), r, first.families) for r in rivals)]

    found = {name: cells(name) for name in first.pairs}
    rows = [(name, *(interval(each.tolist(), ".2f") for each in found[name])) for name in found]
    header = ("ranked by", *(each.task for each in tasks), "mean", f"above {REWARDED}")
    counts = f"{len(first.codes)} codes of {len({*first.families})} families"
    title = f"Rank correlations with mean final returns, {counts}"
    print(Table(title, (*header, f"above {SHORT}"), rows).text())
    *_, mean, above_rewarded, above_short = found[PRIMARY]
    holds = (
        mean.value >= LEAST
        and mean.low > LEAST_LOW
        and min(above_rewarded.low, above_short.low) > 0
    )
    print(
        f"\nHoped for: by {PRIMARY} at least {LEAST} on average, above {LEAST_LOW} at the low end, "
        f"and clearly above both others: {'it is so' if holds else 'it is not so'}"
    )
    for each in tasks:
        print(f"\n{by_code(each).text()}")


if __name__ == "__main__":
    main(*sys.argv[1:])
